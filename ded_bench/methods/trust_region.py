"""The sequence of `ded-slp` where linear models are right only nearby: steps keep within a trust region.

On the full AC network, with constant-power loads and fixed E', many optima lie near the end of what the
network can carry. There a full step may raise the excess, or lead to where there is no solution. Equations
identified from data have none beyond these. So progress is measured by cost + price · excess of |ω|. A step
that brings less than a part of what its program promises is not taken, and the radius of the next program
is a part of it (Fletcher and Sainz de la Maza, Nonlinear programming and nonsmooth optimization by successive
linear programming, 1989).
"""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import NamedTuple, Protocol

import numpy as np

from ded_bench.methods.first_schedules import first_schedules
from ded_bench.methods.knot_program import Attempt, KnotProgram, Limit, solve_with_rows_added
from ded_bench.methods.knots import is_reachable
from ded_bench.methods.slp_accuracy import ACCEPTED, COST_TOLERANCE, MARGIN, OPEN, REFINEMENT
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.time_varying import Indices, TimeVarying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.trajectory import Trajectory
from ded_bench.solvers.status import Status

#: A step that brings less than the first part of what its program promises is not taken; below the second
#: part the radius shrinks, above the third it grows if it limited the step.
TAKEN, POOR, GOOD = 0.1, 0.3, 0.7
#: The radius becomes this part of a step that brings too little, or leads to where there is no solution.
SHORTER, NO_SOLUTION = 0.5, 0.25
#: An excess of |ω| as large as its bound counts like this part of the cost, or more if programs ask for it.
PRICE = 0.05
#: Smallest radius, pu.
SMALLEST = 1e-5
#: Programs of one instance; from the second number on steps shrink until a schedule is feasible.
MAX_PROGRAMS, SETTLING = 40, 20


class Dynamics(Protocol):
    """Equations that can be simulated, and linearised along what they say."""

    def simulate(self, instance: Instance, schedule: Schedule) -> Trajectory:
        """What they say about one schedule.

        Raises:
            SimulationError: they have no solution.
        """
        ...

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TimeVarying:
        """See `trajectory.linearise_along`."""
        ...


class _Iterate(NamedTuple):
    """A schedule and what it leads to."""

    p_gen: Array  # (n_knots, n_gen), pu
    trajectory: Trajectory
    cost: float
    over: float  # by how much |ω| exceeds the bound and what is accepted, rad/s


@dataclasses.dataclass
class TrustRegionSequence:
    """One instance's sequence of trajectories, and programs around them (see `ded_slp.Sequence`)."""

    case: Case
    instance: Instance
    bound: float  # rad/s
    points: Indices  # grid points of the knots
    deadline: float  # on the clock of `time.perf_counter`
    soft: bool = False  # without a feasible schedule there is one, too: that of least excess
    dynamics: Dynamics = field(kw_only=True)
    limits: set[Limit] = field(default_factory=set)
    iterations: int = 0
    claimed: float = np.inf  # cost that the last program predicts
    version: str = ""
    message: str = ""
    _best: _Iterate | None = None  # cheapest strictly feasible one, or that of least excess

    def run(self, start: Schedule, is_near: bool) -> tuple[Status, Schedule | None]:
        """Go on until a simulated schedule confirms its program, or no step brings anything.

        Args:
            start: the first schedule to simulate, if the equations have a solution; its power at t = 0 is
                replaced by P_0.
            is_near: it is thought to be near the optimum: the limits that it comes near get rows at once.
        """
        if not is_reachable(self.case, self.instance, self.points):
            return Status.INFEASIBLE, None
        now = self._first(start)
        if now is None:
            self.message = "the equations have no solution under any schedule that is tried first"
            return Status.FAILED, None
        program = self._program(now)
        if is_near:
            self.limits |= program.near(now.trajectory.omega)
        radius, price, infeasible = np.inf, PRICE * abs(now.cost) / self.bound, 0
        for number in range(MAX_PROGRAMS):
            program.radius = radius
            enough = np.inf if number == 0 and not is_near else max(OPEN, REFINEMENT * now.over)
            attempt = self._solved(program, enough)
            prediction = attempt.prediction
            if prediction is None:
                if attempt.status == Status.TIME_LIMIT or radius == np.inf:
                    return self._end(attempt.status)
                radius *= SHORTER
                continue
            step = float(np.abs(prediction.p_gen - now.p_gen).max())
            is_limited = step > 0.999 * radius
            infeasible = infeasible + 1 if attempt.status == Status.INFEASIBLE and not is_limited else 0
            if infeasible == 2:
                return self._end(Status.INFEASIBLE)
            new = self._simulated(prediction.p_gen)
            small = COST_TOLERANCE * abs(prediction.objective)
            off = np.inf if new is None or new.over > 0.0 else abs(new.cost - prediction.objective)
            if new is not None and off <= small and not is_limited:
                self.claimed = prediction.objective
                return Status.OPTIMAL, self._schedule(new)
            saved, closer = now.cost - prediction.objective, now.over - self._over(prediction.omega)
            price = max(price, -2.0 * saved / closer) if closer > 0.0 else price
            promised = saved + price * closer
            if now.over == 0.0 and (promised <= small or number >= SETTLING):
                break
            gained = -np.inf if new is None else now.cost - new.cost + price * (now.over - new.over)
            if gained < POOR * promised or number >= SETTLING:
                radius = step * (NO_SOLUTION if new is None else SHORTER)
            elif gained > GOOD * promised and is_limited:
                radius *= 2.0
            if new is not None and gained >= TAKEN * promised:
                now, program = new, self._program(new)
            elif radius < SMALLEST:
                break
        self.message = "no step brings the schedule closer to one that is feasible"
        return self._end(Status.FAILED)

    def _first(self, start: Schedule) -> _Iterate | None:
        """The first of some schedules under which the equations have a solution."""
        wanted = start.at(self.instance.grid[self.points])
        wanted[0] = self.instance.p_initial(self.case)
        for p_gen in first_schedules(self.case, self.instance, wanted, self.points):
            found = self._simulated(p_gen)
            if found is not None:
                return found
        return None

    def _program(self, around: _Iterate) -> KnotProgram:
        model = self.dynamics.linearise_along(around.trajectory, self.points)
        return KnotProgram(self.case, self.instance, self.bound - MARGIN, model)

    def _solved(self, program: KnotProgram, enough: float) -> Attempt:
        attempt = solve_with_rows_added(
            program, self.limits, OPEN, enough, self.deadline, by_interval=self.soft
        )
        self.iterations += attempt.iterations
        self.version, self.message = attempt.version, attempt.message
        return attempt

    def _simulated(self, p_gen: Array) -> _Iterate | None:
        """What powers at the knots lead to; None: there is no solution."""
        schedule = Schedule(t=self.instance.grid[self.points], p=p_gen)
        try:
            trajectory = self.dynamics.simulate(self.instance, schedule)
        except SimulationError:
            return None
        instance = self.instance
        cost = float((trajectory.p_gen @ instance.cost_gen(self.case)).sum())
        cost += instance.cost_slack(self.case) * float(np.abs(trajectory.p_slack).sum())
        found = _Iterate(p_gen, trajectory, cost, self._over(trajectory.omega))
        if self._best is None or (found.over, cost) < (self._best.over, self._best.cost):
            self._best = found
        return found

    def _over(self, omega: Array) -> float:
        return max(float(np.abs(omega[1:]).max()) - self.bound - ACCEPTED, 0.0)

    def _end(self, status: Status) -> tuple[Status, Schedule | None]:
        """The best feasible schedule, or why there is none; in operation then that of least excess."""
        best = self._best
        if best is None:
            return status, None
        if best.over > 0.0:
            return (Status.INFEASIBLE, self._schedule(best)) if self.soft else (status, None)
        kept = status if status == Status.TIME_LIMIT else Status.FEASIBLE
        return kept, self._schedule(best)

    def _schedule(self, iterate: _Iterate) -> Schedule:
        return Schedule(t=self.instance.grid[self.points], p=iterate.p_gen)
