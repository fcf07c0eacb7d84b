"""DED by real-time iterations, for operation under tight frequency bounds: the plan in force is corrected.

Plans are made anew again and again, so that the plan in force is nearly optimal for the next instance. A plan
is one step of sequential linear programming, as in nonlinear model predictive control (Diehl, Bock and
Schlöder, 2005): the surrogate's model is taken along the plan in force, and one linear program corrects it.

* Limits of |ω| are soft. Each interval between knots has an excess with a price, an exact penalty above
  nearly all multipliers of the limits. No infeasible program is tried first.
* Limits get rows at once where the plan in force comes near them; where the answer comes near others,
  another program follows.
* Beside a slack plans know when ramps may begin, keep margins and room for them then, and are made when
  there is news (`surprises`). Knots keep their places.
* On islands, what is not measured comes from a simulation of the plan in force (`state_estimate`). There a
  margin of half the bound costs half a per cent and makes peaks of the mean no lower
  (studies/hidden_states.md), so that there is none unless option `margin` asks for it.

A single instance, outside of operation, is answered by two such steps, with no margin but that of the option:
what the first makes of the static dispatch is the plan in force of the second. The first counts as set-up, so
that build and solution times are those of one step, as operation asks for it.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.knot_program import Plan
from ded_bench.methods.knots import case_knots, knots_in_operation, knots_on_clock
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.state_estimate import StateEstimate
from ded_bench.methods.surprises import Surprises
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE, solve_on_surrogate
from ded_bench.problem.case import Case, Indices
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import TRAJECTORY, Surrogate, find_surrogate
from ded_bench.surrogates.koopman import Koopman

#: Raised when answers change.
VERSION = 4
#: Beside a slack, plans are made for so many seconds, and their ends stay: on drawn scenarios of two-area
#: plans of 60 s cost as much, and those of 20 s follow steep ramps too late.
NEAR_S = 30.0


@dataclass(frozen=True)
class Options:
    """Parameters of `ded-rti`."""

    margin: float | None = option(None, "part of the bound left free; none: as ramps ask", lowest=0, below=1)
    reserve: bool = option(True, "room where a ramp may begin, in operation beside a slack")


def prepare(case: Case, regime: str, settings: Settings) -> RealTimeSolver:
    """Return a solver that corrects the plan in force."""
    surrogate = find_surrogate(case, settings.model, settings.search, TRAJECTORY)
    options = read_options(Options, settings.options)
    return RealTimeSolver(case, surrogate, regime, options, settings.time_limit_s)


@dataclass(frozen=True)
class RealTimeSolver:
    """Corrects plans of one case and regime on one surrogate."""

    case: Case
    surrogate: Surrogate
    regime: str
    options: Options = Options()
    time_limit_s: float | None = None  # of a step

    def __call__(self, instance: Instance) -> Solution:
        """Solve by two steps; the first, from the static dispatch, is `setup_s`. Claims nothing."""
        bounds = self._bounds
        if self.case.slack is None:  # condensed programs leave open what they may
            bounds = bounds.tightened(part=SOFT_TOLERANCE)
        knots = case_knots(self.case, instance)
        first = self._step(bounds, instance, knots, Plan(None))
        if first.schedule is None:
            return first
        second = self._step(bounds, instance, knots, Plan(first.schedule))
        setup_s = (first.build_s or 0.0) + (first.solve_s or 0.0)
        if second.status == Status.INFEASIBLE and second.schedule is not None:  # of one linear model
            second = dataclasses.replace(second, status=Status.FEASIBLE, error="")
        return dataclasses.replace(second, setup_s=setup_s)

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule that the penalty makes cheapest.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, is the plan to correct; its time is the instance's.
        """
        in_force = None if last is None else last.schedule
        if self.case.slack is not None:
            return self._when_there_is_news(instance, in_force)
        bounds, knots = self._bounds, knots_in_operation(self.case, instance)
        if self._estimate is None:
            return self._step(bounds, instance, knots, Plan(in_force))
        state = self._estimate.initial(instance, in_force)
        solution = self._step(bounds, instance, knots, Plan(in_force, state=state))
        self._estimate.keep(instance, state, solution.schedule)
        return solution

    def _when_there_is_news(self, instance: Instance, in_force: Schedule | None) -> Solution:
        """Correct the plan in force for what may surprise it; without news it goes on."""
        case, surprises = self.case, self._surprises
        expected = surprises.expected(instance, in_force)
        if in_force is not None and not surprises.is_news(expected):
            without_end = (np.delete(values, -2, axis=0) for values in (in_force.t, in_force.p))
            going_on = Schedule(*without_end)  # the end of the plan in force was no knot
            surprises.keep(going_on)
            return Solution(Status.FEASIBLE, going_on)
        near = expected.until(NEAR_S)
        knots = knots_on_clock(case, near, surprises.now_s)
        room = surprises.room(near.grid[knots[1:]]) if self.options.reserve else None
        margin = surprises.margin(near.grid) if self.options.margin is None else None
        solution = self._step(self._bounds, near, knots, Plan(in_force, room, margin=margin))
        if (plan := solution.schedule) is not None and plan.t[-1] < instance.horizon_s:
            longer = Schedule(np.append(plan.t, instance.horizon_s), np.vstack([plan.p, plan.p[-1:]]))
            solution = dataclasses.replace(solution, schedule=longer)
        surprises.keep(solution.schedule, near)
        return solution

    @functools.cached_property
    def _bounds(self) -> Bounds:
        """The regime's, tighter by the margin that was asked for."""
        return self.case.bounds(self.regime).tightened(part=self.options.margin or 0.0)

    @functools.cached_property
    def _surprises(self) -> Surprises:
        return Surprises(self.case, self.case.omega_bound(self.regime))

    @functools.cached_property
    def _estimate(self) -> StateEstimate | None:
        """On islands, where not all is measured."""
        if self.case.slack is not None or isinstance(self.surrogate, Koopman):
            return None
        return StateEstimate(self.surrogate.plant)

    def _step(self, bounds: Bounds, instance: Instance, knots: Indices, plan: Plan) -> Solution:
        given = self.case, self.surrogate, instance, bounds, knots, self.time_limit_s
        solution = solve_on_surrogate(*given, plan=plan)
        is_claimed = solution.status == Status.OPTIMAL  # of a penalty, roughly
        return dataclasses.replace(solution, status=Status.FEASIBLE) if is_claimed else solution
