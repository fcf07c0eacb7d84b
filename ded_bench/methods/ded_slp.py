"""DED by linear programs along simulated trajectories, on the case's knots.

A schedule is simulated on the case's plant; the linear program around its trajectory (see `knot_program`)
gives the next schedule; and so on until a simulated schedule meets the frequency bound strictly and
costs what its program said. So what is claimed is what the scorer finds: no discretisation error, no
surrogate. It takes one to three programs, since the linear models differ only by the second order
of what one schedule changes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from ded_bench.methods.ed import first_schedules, static_dispatch
from ded_bench.methods.knot_program import KnotProgram, Limit, Prediction
from ded_bench.methods.knots import case_knots, is_reachable
from ded_bench.methods.options import option, read_options
from ded_bench.methods.slp import Attempt, End, Parts, Rows, sequence, solve_with_rows_added
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import PlantState, plant_of, simulate
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.schedule import Schedule, Trajectory
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1
#: Programs keep this much below the bound, and may leave half of it open between the points that have
#: rows: the rest absorbs the model's error of the last program. A schedule is accepted if its simulation
#: exceeds the bound by at most half of what strict feasibility allows (1e-6 Hz). Costs are 1e-6 higher.
MARGIN = 2 * np.pi * 1e-6
OPEN = ACCEPTED = 2 * np.pi * 5e-7
#: Around a trajectory that exceeds the bound, rows are added until this part of its excess is left: the
#: model's error is no smaller, and another trajectory is cheaper than another program. Around the first one
#: a single program is solved, unless it comes from an earlier solution.
REFINEMENT = 0.01
#: So many steps may be of any length: on validation draws 2 to 5 find the same costs to 1e-7, and none fails.
FREE_STEPS = 3
#: Agreement of a simulated schedule's cost with its program's, as a fraction.
COST_TOLERANCE = 1e-6
#: Error of a program's optimum, as a fraction; studies/linear_programs.md tells how many iterations it saves.
ERROR = 2e-7
#: A program is not the last if its trajectory stays clear, by this part of it, of a bound that held it: on
#: validation draws by 6e-4 at most.
PESSIMISM = 5e-3


@dataclass(frozen=True)
class Options:
    """Where schedules bend."""

    knot_s: float | None = option(None, "distance of knots, s; none: the case's knots", lowest=1e-3)


def prepare(case: Case, regime: str, settings: Settings) -> SlpSolver:
    """Return a solver of single instances, which may start from an earlier solution."""
    return SlpSolver(case, regime, read_options(Options, settings.options), settings.time_limit_s)


@dataclass(frozen=True)
class SlpSolver:
    """Solves instances of one case and regime."""

    case: Case
    regime: str
    options: Options = Options()
    time_limit_s: float | None = None

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, is where to start; its time is the instance's.
        """
        return self(instance, last.schedule if last is not None else None, soft=True)

    def __call__(self, instance: Instance, near: Schedule | None = None, soft: bool = False) -> Solution:
        """Solve from a schedule; None: the static dispatch of every second. See `solve` for `soft`."""
        started = time.perf_counter()
        deadline = started + (np.inf if self.time_limit_s is None else self.time_limit_s)
        points = case_knots(self.case, instance, self.options.knot_s)
        bounds = self.case.bounds(self.regime)
        parts = _OnPlant(self.case, instance, bounds, points, deadline, soft, near is not None)
        if is_reachable(self.case, instance, points):
            end = parts.run(static_dispatch(self.case, instance) if near is None else near)
        else:
            end = End(Status.INFEASIBLE, None, None, 0, "")
        status, schedule = parts.verdict(end)
        claimed = end.answer.solution if end.answer is not None else None
        is_given = schedule is not None and status != Status.INFEASIBLE
        return Solution(
            status=status,
            schedule=schedule,
            iterations=end.iterations,
            build_s=0.0,
            setup_s=0.0,
            solve_s=time.perf_counter() - started,
            solver_objective=claimed.objective if claimed and status == Status.OPTIMAL else None,
            solver_version=end.answer.version if end.answer is not None else "",
            error="" if is_given else end.message if status == Status.FAILED else status.sentence,
        )


@dataclass(frozen=True, eq=False)
class Simulated:
    """A schedule and what it leads to."""

    at: Array  # powers at the knots, (n_knots, n_gen), pu
    trajectory: Trajectory
    cost: float
    excess: float  # over the bounds, rad/s


@dataclass
class _OnPlant:
    """The parts of one instance's sequence."""

    case: Case
    instance: Instance
    bounds: Bounds
    points: Indices
    deadline: float  # on the clock of `time.perf_counter`
    soft: bool  # an infeasible instance has a schedule, too: that of least excess
    is_near: bool  # the first schedule is thought to be near the optimum: its limits get rows at once
    limits: set[Limit] = field(default_factory=set)
    last: KnotProgram | None = None
    best: Simulated | None = None  # the cheapest strictly feasible one
    steps: list[float] = field(default_factory=list)  # largest move of a set-point by each program, pu
    radius: float = np.inf  # most that a program may move one, pu
    state: PlantState = None  # of the plant at t = 0

    def run(self, start: Schedule) -> End[Simulated, Prediction]:
        """Go on until a simulated schedule confirms its program; P_0 replaces the start's first power."""
        wanted = start.at(self.instance.grid[self.points])
        wanted[0] = self.instance.p_initial(self.case)
        first = first_schedules(self.case, self.instance, wanted, self.points)
        return sequence(Parts(self._follow, self._solve, self._is_confirmed), first, self.deadline)

    def verdict(self, end: End[Simulated, Prediction]) -> tuple[Status, Schedule | None]:
        """What to claim at the end: the confirmed schedule, the best one, or that of least excess."""
        if end.status == Status.OPTIMAL and end.followed is not None:
            return end.status, self._schedule(end.followed.at)
        best = None if self.best is None else self._schedule(self.best.at)
        if end.status == Status.INFEASIBLE and (self.soft or best is None):
            nearest = end.answer.wanted if self.soft and end.answer is not None else None
            return end.status, None if nearest is None else self._schedule(nearest)
        is_over = end.status in (Status.FAILED, Status.INFEASIBLE)
        return (Status.FEASIBLE if best and is_over else end.status), best

    def _schedule(self, p_gen: Array) -> Schedule:
        return Schedule(t=self.instance.grid[self.points], p=p_gen)

    def _follow(self, p_gen: Array) -> Simulated:
        if self.state is None:
            self.state = plant_of(self.case).initial(self.instance)
        trajectory = simulate(self.case, self.instance, self._schedule(p_gen), state=self.state)
        cost = trajectory.cost(self.instance.cost_gen(self.case), self.instance.cost_slack(self.case))
        # After t_0: x_0 is given, wherever it lies.
        excess = float(self.bounds.beyond(trajectory.omega @ self.bounds.matrix.T)[1:].max())
        found = Simulated(p_gen, trajectory, cost, excess)
        if found.excess <= ACCEPTED and (self.best is None or cost < self.best.cost):
            self.best = found
        return found

    def _solve(self, around: Simulated, number: int) -> Attempt[Prediction]:
        model = plant_of(self.case).linearise_along(around.trajectory, self.points)
        given = self.case, self.instance, self.bounds.tightened(MARGIN), model
        error = ERROR * abs(around.cost)
        self.last = program = KnotProgram(*given, radius=self.radius, before=self.last, error=error)
        if self.is_near or not (number or program.condensed):  # a condensed program's rows are dense
            self.limits |= program.near(program.model.omega)
        enough = max(OPEN, REFINEMENT * around.excess) if number or self.is_near else np.inf
        attempt = solve_with_rows_added(program, self.limits, Rows(OPEN, enough), self.deadline)
        if attempt.wanted is not None:
            self.steps.append(float(np.abs(attempt.wanted - around.at).max()))
            # Where steps do not shrink, programs jump between vertices of nearly the same cost.
            if np.isfinite(self.radius):
                self.radius /= 2
            elif len(self.steps) >= FREE_STEPS and self.steps[-1] > self.steps[-2] / 2:
                self.radius = self.steps[-1] / 2
        return attempt

    def _is_confirmed(self, found: Simulated, claimed: Prediction) -> bool:
        """Whether a schedule meets the bound, costs what its program said, and is as near the bound."""
        outputs = claimed.outputs, found.trajectory.omega @ self.bounds.matrix.T
        said, true = (self.bounds.beyond(one)[1:].max(axis=0) / self.bounds.limit for one in outputs)
        is_held = not ((said > -PESSIMISM) & (said - true > PESSIMISM)).any()  # else there is more to gain
        error = max(abs(found.cost - claimed.objective), self.last.fixed.gap if self.last else 0.0)
        return found.excess <= ACCEPTED and error <= COST_TOLERANCE * abs(found.cost) and is_held
