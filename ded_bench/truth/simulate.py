"""What really happens under a schedule: the index-1 swing DAE, integrated with scipy."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import DOP853, RK45

from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.network import Network, PowerFlowError

if TYPE_CHECKING:
    import pandas as pd

#: Local error control of the integrators; steps of one grid interval are well inside it.
RTOL, ATOL = 1e-9, 1e-10
LONG_RTOL, LONG_ATOL = 1e-11, 1e-12
#: Inputs that bend by less are linear, pu.
ROUND_OFF = 1e-12
#: Points whose loads' angles are solved for together: more would not stay in the cache.
POINTS_AT_ONCE = 500


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
    """Integrate instances side by side with scipy's explicit Runge-Kutta methods.

    Load-bus angles are solved by Newton's method at every evaluation of the right-hand side. No
    step spans a grid point where a schedule or a load bends. From one grid point to the next goes
    the method of order 5(4); further goes that of order 8, whose dense output gives the points between.

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
    try:
        run = _Run(Network(case), instances, schedules)
        for first, last in itertools.pairwise(bends(run.p_gen, run.p_load)):
            run.advance(first, last)
        theta = run.all_angles()
    except PowerFlowError as error:
        raise SimulationError(f"the system cannot follow this schedule: {error}") from None
    p_slack = run.network.injections(theta)[:, :, run.network.slack]
    grid, omega, p_gen, p_load = run.grid, run.omega, run.p_gen, run.p_load
    return [
        Trajectory(grid, theta[:, b], omega[:, b], p_gen[:, b], p_load[:, b], p_slack[:, b], case)
        for b in range(len(instances))
    ]


def bends(*inputs: Array) -> list[int]:
    """Grid points, with the first and the last, between which all inputs are linear.

    Args:
        inputs: time is their first axis, pu.
    """
    bent = np.ones(len(inputs[0]), dtype=bool)
    bent[1:-1] = False
    for values in inputs:
        with np.errstate(over="ignore", invalid="ignore"):  # what is beyond all measure is no line
            straight = np.abs(np.diff(values, n=2, axis=0)) <= ROUND_OFF
        bent[1:-1] |= ~straight.all(axis=tuple(range(1, straight.ndim)))
    return [int(k) for k in np.flatnonzero(bent)]


class _Run:
    """Instances that are integrated side by side; in all arrays time comes first, then the instance."""

    def __init__(
        self, network: Network, instances: Sequence[Instance], schedules: Sequence[Schedule]
    ) -> None:
        self.network, self.grid, self._dt = network, instances[0].grid, instances[0].dt_s
        self.p_gen = np.stack([s.at(self.grid) for s in schedules], axis=1)
        self.p_load = np.stack([i.p_load(network.case) for i in instances], axis=1)
        self.omega = np.empty(self.p_gen.shape)
        self.omega[0] = np.stack([i.omega_initial(network.case) for i in instances])
        self._theta = np.empty((*self.p_gen.shape[:2], network.n_bus))
        self._theta[0] = np.stack([network.initial_angles(i) for i in instances])
        self._injection = network.load_injections(self.p_load)
        self._whole = np.arange(len(self.grid)) == 0  # where _theta has all buses, not only generators
        self._ends = [(0.0, self._theta[0])]  # times and angles of all buses where steps end
        self._recent = dict(self._ends)  # the same at the last evaluations
        self._slope: Array | None = None  # right-hand side where the last step ended
        # Longer steps would leave the region where explicit methods are stable, and Newton's guesses.
        fastest = np.abs(network.linearise(self._theta[0, 0]).modes()).max()
        self._longest_s, self._long_step_s = 1.0 / fastest, self._dt

    def advance(self, first: int, last: int) -> None:
        """Integrate from a grid point to another; inputs are linear between them."""
        start, stop = self.grid[first], self.grid[last]
        angles, slope = self._theta[first], self._slope

        def rhs(t: float, y: Array) -> Array:
            nonlocal angles
            if slope is not None and t == start:
                return slope
            cell = min(max(int(t / self._dt), first), last - 1)
            inside = (t - self.grid[cell]) / self._dt
            state = y.reshape(2, *self.omega.shape[1:])
            angle, speed = state[0], state[1]
            guess = _extrapolated(self._recent, t)
            guess[:, self.network.generators] = angle
            angles, injections = self.network.solve_loads(guess, _between(self._injection, cell, inside))
            self._remember(t, angles)
            force = injections[:, self.network.generators]
            rate = self.network.acceleration(speed, _between(self.p_gen, cell, inside), force)
            return np.concatenate([speed.ravel(), rate.ravel()])

        y = np.concatenate([angles[:, self.network.generators].ravel(), self.omega[first].ravel()])
        short = last == first + 1
        method, rtol, atol = (RK45, RTOL, ATOL) if short else (DOP853, LONG_RTOL, LONG_ATOL)
        longest_s = stop - start if short else self._longest_s
        step_s = min(longest_s if short else self._long_step_s, stop - start)
        solver = method(rhs, start, y, stop, longest_s, rtol, atol, first_step=step_s)
        done = first
        while solver.status == "running":
            solver.step()
            if solver.status == "failed":
                raise SimulationError("the integrator's step size vanished")
            # The last evaluation of a step is at its end, where the next one starts.
            self._slope = solver.f
            self._ends.append((solver.t, angles))
            reached = int(np.searchsorted(self.grid, solver.t, side="right")) - 1
            if not short:
                self._long_step_s = solver.h_abs
                self._keep(slice(done + 1, reached + 1), solver.dense_output())
            done = reached
        self._theta[last] = self._ends[-1][1]
        self.omega[last] = solver.y.reshape(2, *self.omega.shape[1:])[1]
        self._whole[last] = True
        # It refers to itself, and would keep this run's arrays until Python collects garbage.
        vars(solver).clear()

    def _keep(self, points: slice, states: Callable[[Array], Array]) -> None:
        """Keep what a dense output says at grid points; the loads' angles are solved for in the end."""
        times = self.grid[points]
        if len(times):
            y = states(times).T.reshape(len(times), 2, *self.omega.shape[1:])
            self._theta[points][:, :, self.network.generators], self.omega[points] = y[:, 0], y[:, 1]

    def _remember(self, t: float, angles: Array) -> None:
        near = [s for s in self._recent if abs(s - t) < 1e-3 * self._dt]  # useless to extrapolate from
        for s in near or list(self._recent)[:-2]:
            del self._recent[s]
        self._recent[t] = angles

    def all_angles(self) -> Array:
        """Angles of all buses at all grid points, shape (n, batch, n_bus), rad."""
        missing = np.flatnonzero(~self._whole)
        ends = np.array([t for t, _ in self._ends])
        for start in range(0, len(missing), POINTS_AT_ONCE):
            points = missing[start : start + POINTS_AT_ONCE]
            times = self.grid[points]
            after = np.searchsorted(ends, times)
            near = np.stack([self._ends[k][1] for k in range(after[0] - 1, after[-1] + 1)])
            part = ((times - ends[after - 1]) / (ends[after] - ends[after - 1]))[:, None, None]
            place = after - after[0]
            guess = (1.0 - part) * near[place] + part * near[place + 1]
            guess[:, :, self.network.generators] = self._theta[points][:, :, self.network.generators]
            self._theta[points], _ = self.network.solve_loads(guess, self._injection[points])
        return self._theta


def _between(values: Array, cell: int, inside: float) -> Array:
    """Linear interpolation between two neighbouring points."""
    return np.asarray(values[cell] + inside * (values[cell + 1] - values[cell]))


def _extrapolated(values: Mapping[float, Array], t: float) -> Array:
    """The polynomial through values at other times, at t: so near that Newton mostly needs one step."""
    total: Array | float = 0.0
    for a, value in values.items():
        weight = 1.0
        for b in values:
            if b != a:
                weight *= (t - b) / (a - b)
        total = total + weight * value
    return np.array(total)
