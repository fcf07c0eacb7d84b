"""DED by linear programs along simulated trajectories, on the case's knots.

A schedule is simulated on the true DAE; the linear program around its trajectory (see `knot_program`)
gives the next schedule; and so on until a simulated schedule meets the frequency bound strictly and
costs what its program said. So what is claimed is what the scorer finds: no discretisation error, no
surrogate. It takes one to three programs, since the linear models differ only by the second order
of what one schedule changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from ded_bench.methods import ed
from ded_bench.methods.knot_program import KnotProgram, Limit, solve_with_rows_added
from ded_bench.methods.knots import is_reachable, knot_points
from ded_bench.methods.options import option, read_options
from ded_bench.methods.slp_accuracy import ACCEPTED, COST_TOLERANCE, MARGIN, OPEN, REFINEMENT
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.plants.simulate import simulate
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.trajectory import Trajectory
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1
#: Trajectories, and halvings of a step that the system cannot follow.
MAX_ROUNDS, MAX_HALVINGS = 15, 6


@dataclass(frozen=True)
class Options:
    """Where schedules bend."""

    knot_s: float | None = option(None, "distance of knots, s; none: the case's knots", lowest=1e-3)


def prepare(case: Case, regime: str, settings: Settings) -> SlpSolver:
    """Return a solver of single instances, which may start from an earlier solution."""
    case.check_regimes([regime])
    options = read_options(Options, settings.options)
    return SlpSolver(case, regime, settings.time_limit_s, options.knot_s)


class Sequence(Protocol):
    """One instance's sequence of trajectories and programs."""

    iterations: int  # of all programs
    claimed: float  # cost that the last program predicts
    version: str  # of the solver
    message: str

    def run(self, start: Schedule, is_near: bool) -> tuple[Status, Schedule | None]:
        """Go on until a simulated schedule confirms its program.

        Args:
            start: the first schedule to simulate; its power at t = 0 is replaced by P_0.
            is_near: it is thought to be near the optimum: the limits that it comes near get rows at once.
        """
        ...


#: Makes a sequence of: case, instance, bound (rad/s), grid points of the knots, deadline (on the clock of
#: `time.perf_counter`), and whether an infeasible instance has a schedule, too.
Start = Callable[[Case, Instance, float, Indices, float, bool], Sequence]


@dataclass(frozen=True)
class SlpSolver:
    """Solves instances of one case and regime."""

    case: Case
    regime: str
    time_limit_s: float | None = None
    knot_interval_s: float | None = None  # None: the case's knots
    sequence: Start | None = None  # None: on the lossless network

    def __call__(self, instance: Instance) -> Solution:
        """Solve from the static dispatch of every second."""
        return self._solution(instance, None, soft=False)

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, is where to start; its time is the instance's.
        """
        return self._solution(instance, last, soft=True)

    def _solution(self, instance: Instance, last: Solution | None, soft: bool) -> Solution:
        started = time.perf_counter()
        limit = np.inf if self.time_limit_s is None else self.time_limit_s
        near = last.schedule if last is not None else None
        start = ed.dispatch(self.case, instance, 1.0) if near is None else near
        points = self._knots(instance)
        bound = self.case.omega_bound(self.regime)
        make = self.sequence or _Sequence
        sequence = make(self.case, instance, bound, points, started + limit, soft)
        status, schedule = sequence.run(start, is_near=near is not None)
        return Solution(
            status=status,
            schedule=schedule,
            iterations=sequence.iterations,
            build_s=0.0,
            setup_s=0.0,
            solve_s=time.perf_counter() - started,
            solver_objective=sequence.claimed if status == Status.OPTIMAL else None,
            solver_version=sequence.version,
            error=_reason(status, schedule, sequence.message),
        )

    def _knots(self, instance: Instance) -> Indices:
        """Grid points of the knots."""
        times = self.case.knot_times(instance.horizon_s)
        if self.knot_interval_s is not None:
            times = np.linspace(0.0, instance.horizon_s, round(instance.horizon_s / self.knot_interval_s) + 1)
        return knot_points(times, instance.dt_s)


@dataclass
class _Sequence:
    """One instance's sequence of trajectories and programs."""

    case: Case
    instance: Instance
    bound: float  # rad/s
    points: Indices
    deadline: float  # on the clock of `time.perf_counter`
    soft: bool = False  # an infeasible instance has a schedule, too: that of least excess
    limits: set[Limit] = field(default_factory=set)
    iterations: int = 0
    claimed: float = np.inf  # cost that the last program predicts
    version: str = ""
    message: str = ""
    _cheapest: float = np.inf
    _best: Schedule | None = None  # cheapest strictly feasible schedule simulated

    def run(self, start: Schedule, is_near: bool) -> tuple[Status, Schedule | None]:
        """Go on until a simulated schedule confirms its program.

        Args:
            start: the first schedule to simulate; its power at t = 0 is replaced by P_0.
            is_near: it is thought to be near the optimum: the limits that it comes near get rows at once.
        """
        if not is_reachable(self.case, self.instance, self.points):
            return Status.INFEASIBLE, None
        p_gen = start.at(self.instance.grid[self.points])
        p_gen[0] = self.instance.p_initial(self.case)
        p_before, infeasible = p_gen, 0
        for number in range(MAX_ROUNDS):
            if time.perf_counter() > self.deadline:
                return Status.TIME_LIMIT, self._best
            try:
                p_gen, trajectory = self._follow(p_before, p_gen)
            except SimulationError as error:
                self.message = str(error)
                break
            schedule = Schedule(t=trajectory.t[self.points], p=p_gen)
            excess = float(np.abs(trajectory.omega[1:]).max()) - self.bound
            if excess <= ACCEPTED and self._confirmed(trajectory, schedule):
                return Status.OPTIMAL, schedule
            model = plant_of(self.case).linearise_along(trajectory, self.points)
            program = KnotProgram(self.case, self.instance, self.bound - MARGIN, model)
            if is_near:
                self.limits |= program.near(trajectory.omega)
            enough = np.inf if number == 0 and not is_near else max(OPEN, REFINEMENT * excess)
            attempt = solve_with_rows_added(
                program, self.limits, OPEN, enough, self.deadline, by_interval=self.soft
            )
            self.iterations += attempt.iterations
            self.version, self.message, prediction = attempt.version, attempt.message, attempt.prediction
            if prediction is None:
                return attempt.status, self._best
            infeasible = infeasible + 1 if attempt.status == Status.INFEASIBLE else 0
            if infeasible == 2:
                nearest = Schedule(t=schedule.t, p=prediction.p_gen)
                return Status.INFEASIBLE, nearest if self.soft else None
            p_before, p_gen, self.claimed = p_gen, prediction.p_gen, prediction.objective
        else:
            self.message = f"no convergence in {MAX_ROUNDS} trajectories"
        return (Status.FAILED if self._best is None else Status.FEASIBLE), self._best

    def _follow(self, p_before: Array, p_gen: Array) -> tuple[Array, Trajectory]:
        """Simulate, closer to the powers before if the system cannot follow.

        Raises:
            SimulationError: not even then.
        """
        for _ in range(MAX_HALVINGS):
            try:
                schedule = Schedule(t=self.instance.grid[self.points], p=p_gen)
                return p_gen, simulate(self.case, self.instance, schedule)
            except SimulationError:
                p_gen = (p_before + p_gen) / 2
        raise SimulationError("the system cannot follow any schedule on the way to the program's")

    def _confirmed(self, trajectory: Trajectory, schedule: Schedule) -> bool:
        """Whether a schedule that meets the bound costs what its program said; keeps the best one."""
        instance = self.instance
        generation = float((trajectory.p_gen @ instance.cost_gen(self.case)).sum())
        cost = generation + instance.cost_slack(self.case) * float(np.abs(trajectory.p_slack).sum())
        if cost < self._cheapest:
            self._cheapest, self._best = cost, schedule
        return abs(cost - self.claimed) <= COST_TOLERANCE * abs(cost)


def _reason(status: Status, schedule: Schedule | None, message: str) -> str:
    """Why there is no schedule that meets every limit; nothing if there is one."""
    if status == Status.FAILED:
        return message
    return status.sentence if schedule is None or status == Status.INFEASIBLE else ""
