"""What really happens under a schedule: the index-1 swing DAE, integrated over the grid of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import DOP853

from ded_bench.plants.lossless.integrator import Inputs, Tableau, integrate
from ded_bench.plants.lossless.network import Network, PowerFlowError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.state import State

if TYPE_CHECKING:
    import pandas as pd

#: Dormand and Prince's method of order 8 (Hairer, Norsett and Wanner, Solving Ordinary Differential
#: Equations I, II.5), with SciPy's coefficients.
METHOD = Tableau(DOP853.A.copy(), DOP853.B.copy(), DOP853.C.copy())
#: Longest step times the fastest mode: far inside the region of stability, and errors are below 1e-12.
STEP_BY_MODE = 0.25


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


def simulate(case: Case, instance: Instance, schedule: Schedule, state: State | None = None) -> Trajectory:
    """Integrate one instance under one schedule.

    Steps of fixed length lead from one grid point to the next, so that no step spans one where a schedule
    or a load bends.

    Args:
        case: the grid.
        instance: its loads, and its state at t = 0 unless another is given.
        schedule: generator powers.
        state: where the generators are at t = 0; need not be an equilibrium.

    Raises:
        SimulationError: the algebraic equations have no solution at some time.
        InputError: an instance is of another case, or a schedule does not span its horizon.
    """
    instance.check_case(case)
    schedule.check(instance.horizon_s)
    network = Network(case)
    p_gen, p_load = schedule.at(instance.grid), instance.p_load(case)
    theta = np.empty((len(p_gen), network.n_bus))
    omega, p_slack = np.empty(p_gen.shape), np.empty(len(p_gen))
    omega[0] = instance.omega_initial(case) if state is None else state.omega
    try:
        theta[0] = network.initial_angles(instance) if state is None else network.angles(state, p_load[0])
    except PowerFlowError as error:
        raise SimulationError(f"the system cannot follow this schedule: {error}") from None
    fastest = np.abs(network.linearise(theta[0]).modes()).max()
    steps = max(int(np.ceil(fastest * instance.dt_s / STEP_BY_MODE)), 1)
    inputs = Inputs(p_gen, network.load_injections(p_load), instance.dt_s)
    try:
        done = integrate(METHOD, network.grid, inputs, steps, theta, omega, p_slack)
    except np.linalg.LinAlgError:
        done = 0
    if done < len(p_gen):
        raise SimulationError("the system cannot follow this schedule: the power flow has no solution")
    return Trajectory(instance.grid, theta, omega, p_gen, p_load, p_slack, case)
