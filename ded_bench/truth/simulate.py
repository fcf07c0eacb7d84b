"""What really happens under a schedule: the index-1 swing DAE, integrated with scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import RK45

from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.swing import Network, PowerFlowError

if TYPE_CHECKING:
    import pandas as pd

#: Local error control of the integrator; steps of one grid interval are well inside it.
RTOL, ATOL = 1e-9, 1e-10


class SimulationError(ArithmeticError):
    """The system lost synchronism: the algebraic equations have no solution any more."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What one instance does under one schedule, at the grid points t_k."""

    t: Array  # (n,), s
    theta: Array  # (n, n_bus), rad, relative to the slack
    omega: Array  # (n, n_gen), rad/s, deviation from nominal
    p_gen: Array  # (n, n_gen), pu
    p_load: Array  # (n, n_load), pu
    p_slack: Array  # (n,), pu
    case: Case

    def to_frame(self) -> pd.DataFrame:
        """One row per grid point, columns named by bus in the case's order.

        `t` (s); `P_<bus>` of the generators, then of the slack (pu); `L_<bus>` of the loads (injections,
        pu); `omega_<bus>` of the generators (rad/s, deviation from nominal); `theta_<bus>` (rad,
        relative to the slack).
        """
        import pandas as pd  # here only: the scorer does without it

        case = self.case
        columns = {"t": self.t}
        columns |= {f"P_{bus}": values for bus, values in zip(case.generators, self.p_gen.T, strict=True)}
        columns[f"P_{case.slack}"] = self.p_slack
        columns |= {f"L_{bus}": values for bus, values in zip(case.loads, self.p_load.T, strict=True)}
        columns |= {f"omega_{bus}": values for bus, values in zip(case.generators, self.omega.T, strict=True)}
        columns |= {f"theta_{bus.id}": values for bus, values in zip(case.buses, self.theta.T, strict=True)}
        return pd.DataFrame(columns)


def simulate(case: Case, instance: Instance, schedule: Schedule) -> Trajectory:
    """Integrate one instance under one schedule; see `simulate_many`."""
    return simulate_many(case, [instance], [schedule])[0]


def simulate_many(
    case: Case, instances: Sequence[Instance], schedules: Sequence[Schedule]
) -> list[Trajectory]:
    """Integrate instances side by side with scipy's explicit Runge-Kutta 5(4).

    Load-bus angles are solved by Newton's method at every evaluation of the right-hand side. No
    step spans a grid point, where schedules and loads may have kinks; within a step the inputs are
    linear in time.

    Raises:
        ValueError: the instances do not share one time grid.
        SimulationError: some instance has no solution at some time.
        InputError: an instance is of another case, or a schedule does not span its horizon.
    """
    for instance, schedule in zip(instances, schedules, strict=True):
        instance.check_case(case)
        schedule.check(instance.horizon_s)
    if len({(i.steps, i.dt_s) for i in instances}) != 1:
        raise ValueError("instances simulated side by side must share one time grid")
    grid, dt = instances[0].grid, instances[0].dt_s
    network = Network(case)
    n_gen, batch = len(case.generators), len(instances)
    p_gen = np.stack([s.at(grid) for s in schedules], axis=1)  # time first: one row per step
    p_load = np.stack([i.p_load(case) for i in instances], axis=1)
    injection = network.load_injections(p_load)
    theta = np.empty((len(grid), batch, network.n_bus))
    omega = np.empty((len(grid), batch, n_gen))
    try:
        theta[0] = np.stack([network.initial_angles(i) for i in instances])
        omega[0] = np.stack([i.omega_initial(case) for i in instances])
        angles = theta[0]
        recent = {0.0: angles}  # at the times of the last evaluations
        slope: Array | None = None  # at the end of the last step, hence at the start of the next

        def rhs(t: float, y: Array) -> Array:
            nonlocal angles
            if slope is not None and t == grid[step]:
                return slope
            angle, speed = y.reshape(2, batch, n_gen)
            inside = (t - grid[step]) / dt
            guess = _extrapolated(recent, t)
            guess[:, network.generators] = angle
            wanted = injection[step] + inside * (injection[step + 1] - injection[step])
            angles, injections = network.solve_loads(guess, wanted)
            recent[t] = angles
            if len(recent) > 3:
                del recent[next(iter(recent))]
            power = p_gen[step] + inside * (p_gen[step + 1] - p_gen[step])
            force = injections[:, network.generators]
            return np.concatenate([speed.ravel(), network.acceleration(speed, power, force).ravel()])

        for step in range(len(grid) - 1):
            y = np.concatenate([theta[step][:, network.generators].ravel(), omega[step].ravel()])
            start, stop = grid[step], grid[step + 1]
            solver = RK45(rhs, start, y, stop, first_step=stop - start, rtol=RTOL, atol=ATOL)
            while solver.status == "running":
                solver.step()
            if solver.status == "failed":
                raise SimulationError("the integrator's step size vanished")
            # The last evaluation of a step is at its end, where the next one starts.
            theta[step + 1], omega[step + 1] = angles, solver.y.reshape(2, batch, n_gen)[1]
            slope = solver.f
    except PowerFlowError as error:
        raise SimulationError(f"the system cannot follow this schedule: {error}") from None
    p_slack = network.injections(theta)[:, :, network.slack]
    return [
        Trajectory(grid, theta[:, b], omega[:, b], p_gen[:, b], p_load[:, b], p_slack[:, b], case)
        for b in range(batch)
    ]


def _extrapolated(values: Mapping[float, Array], t: float) -> Array:
    """The polynomial through values at other times, at t: so near that Newton mostly needs one step."""
    weights = (math.prod((t - b) / (a - b) for b in values if b != a) for a in values)
    return np.asarray(sum(w * value for w, value in zip(weights, values.values(), strict=True)))
