"""DED-KO on knots by real-time iterations: the setting `real-time` of `ded-ko-knots`.

In operation plans come every second or faster, and the last one is a good guess of the next. So each plan
is one step of sequential linear programming, as in nonlinear model predictive control (Diehl, Bock and
Schlöder, 2005): the surrogate's model is taken along the plan in force, and one linear program corrects it.

* Limits of |ω| are soft. Each interval between knots has an excess with a price, an exact penalty above
  nearly all multipliers of the limits. No infeasible program is tried first.
* Limits get rows at once where the plan in force comes near them; where the answer comes near others,
  another program follows.
* Knots keep their places and plans a margin below the bound, as in `receding`.

A single instance, outside of operation, is answered without a margin by two such steps: what the first
makes of the static dispatch is the plan in force of the second. The first counts as set-up, so that build
and solution times are those of one step, as operation asks for it.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.artifact import Artifact, model_artifact
from ded_bench.methods.first_schedules import first_schedules
from ded_bench.methods.knot_program import KnotProgram, Limit, Prediction
from ded_bench.methods.knots import is_reachable, receding_knots, tightened
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import reference
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.plants.simulate import simulate
from ded_bench.plants.time_varying import Indices, TimeVarying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.highs import solve_form as solve_by_highs
from ded_bench.solvers.linear_program import FormAnswer
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import TRAJECTORY, Surrogate, find_surrogate
from ded_bench.surrogates.instance_model import model_along

#: Raised when answers change.
VERSION = 1
#: What an excess of 1 rad/s through one interval costs, in sums of all columns' costs.
PRICE = 10.0
#: Relative duality gap, and residuals, that are small enough; regularisation. All chosen on validation draws.
GAP, RESIDUAL, REGULARISATION = 1e-3, 1e-5, 1e-9
#: Relative excess between rows that needs no further program, and most programs of a plan.
OPEN, PROGRAMS = 0.02, 4


@dataclass(frozen=True)
class Options:
    """How plans are made."""

    margin: float = option(
        0.5, "part of the bound that plans leave free", lowest=0.0, highest=0.99, in_operation=True
    )
    reserve: bool = option(False, "room to follow ramps that nobody announced")


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The surrogate that `prepare` would use."""
    return (model_artifact(case, settings, TRAJECTORY),)


def prepare(case: Case, regime: str, settings: Settings) -> RealTimeSolver:
    """Return a solver that corrects the plan in force."""
    case.check_regimes([regime])
    from ded_bench.methods.real_time_reserve import ReserveSolver

    surrogate = find_surrogate(case, settings.model or TRAJECTORY, settings.search)
    limit_s = np.inf if settings.time_limit_s is None else settings.time_limit_s
    options = read_options(Options, settings.options)
    kind = ReserveSolver if options.reserve else RealTimeSolver
    return kind(case, surrogate, regime, options.margin, limit_s)


class SoftProgram(KnotProgram):
    """The program around one trajectory with a priced excess of |ω| in every interval."""

    def solve_soft(self, limits: set[Limit], deadline: float) -> FormAnswer:
        """Solve with |ω| limited softly at all knots and at the points chosen.

        Args:
            limits: the points, by generator.
            deadline: on the clock of `time.perf_counter`.

        Returns:
            As `KnotProgram.solve`; the objective is not that of the plan alone.
        """
        rows = np.array(sorted(limits), dtype=int).reshape(-1, 2)
        form, order = self._relaxed_form(rows, True, PRICE)
        left = deadline - time.perf_counter()
        answer = solve_form(form, left, True, REGULARISATION, GAP, RESIDUAL)
        if answer.status == Status.FAILED:
            answer = self._answer(form, deadline - time.perf_counter())
        if answer.status == Status.FAILED:
            answer = solve_by_highs(form, max(deadline - time.perf_counter(), 0.0))
        if answer.status != Status.OPTIMAL:
            return answer
        x = np.empty(len(order))
        x[order] = answer.x
        return dataclasses.replace(answer, x=x[: self._n_columns])


@dataclass(frozen=True)
class RealTimeSolver:
    """Corrects plans of one case and regime on one surrogate."""

    case: Case
    surrogate: Surrogate
    regime: str
    margin: float  # part of the bound
    limit_s: float = np.inf  # of a step

    def __call__(self, instance: Instance) -> Solution:
        """Solve by two steps; the first, from the static dispatch, is `setup_s`."""
        first = self._step(self.case, instance, None)
        if first.schedule is None:
            return first
        second = self._step(self.case, instance, first.schedule)
        return dataclasses.replace(second, setup_s=(first.build_s or 0.0) + (first.solve_s or 0.0))

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule that the penalty makes cheapest.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, is the plan to correct; its time is the instance's.
        """
        return self._step(self._planning_case, instance, None if last is None else last.schedule)

    @functools.cached_property
    def _planning_case(self) -> Case:
        return tightened(self.case, self.margin)

    def _step(self, case: Case, instance: Instance, last: Schedule | None) -> Solution:
        started = time.perf_counter()
        points = receding_knots(case, instance, last)
        if not is_reachable(case, instance, points):
            return Solution(Status.INFEASIBLE, error=Status.INFEASIBLE.sentence)
        try:
            model = self._model(instance, last, points)
        except SimulationError as error:
            return Solution(Status.FAILED, error=str(error))
        program = SoftProgram(case, instance, case.omega_bound(self.regime), model)
        built = time.perf_counter()
        limits = set() if last is None else program.near(model.omega)
        answer, prediction, iterations = self._solved(program, limits, started + self.limit_s)
        if prediction is None:
            return Solution(answer.status, iterations=iterations, error=answer.message)
        exceeds = program.excess(prediction.omega) > OPEN * program.bound
        status = Status.INFEASIBLE if exceeds else Status.FEASIBLE
        return Solution(
            status=status,
            schedule=Schedule(instance.grid[points], prediction.p_gen),
            iterations=iterations,
            build_s=built - started,
            setup_s=0.0,
            solve_s=time.perf_counter() - built,
            solver_objective=None if exceeds else prediction.objective,
            solver_version=answer.version,
            error=status.sentence if exceeds else "",
        )

    def _model(self, instance: Instance, last: Schedule | None, points: Indices) -> TimeVarying:
        """The surrogate's model along the plan in force, or what the network can carry instead."""
        wanted = self._within_ramps(instance, last, points)
        for p_gen in first_schedules(self.case, instance, wanted, points):
            try:
                if self.surrogate.kind != TRAJECTORY:
                    return model_along(self.case, self.surrogate, instance, p_gen, points)
                plan, plant = Schedule(instance.grid[points], p_gen), plant_of(self.case)
                run = simulate(self.case, instance, plan, plant, exact=False)
                return plant.linearise_along(run, points)
            except SimulationError as error:
                reason = error
        raise reason

    def _within_ramps(self, instance: Instance, last: Schedule | None, points: Indices) -> Array:
        """The plan in force, or else the static dispatch, at the knots, (n_knots, n_gen), pu."""
        if last is None:
            return reference(self.case, instance, points)
        p_gen = last.at(instance.grid[points])
        p_gen[0] = instance.p_initial(self.case)
        reach = np.outer(np.diff(points) * instance.dt_s, self.case.ramp)
        for j, most in enumerate(reach):
            p_gen[j + 1] = p_gen[j] + np.clip(p_gen[j + 1] - p_gen[j], -most, most)
        return p_gen

    @staticmethod
    def _solved(
        program: SoftProgram, limits: set[Limit], deadline: float
    ) -> tuple[FormAnswer, Prediction | None, int]:
        """The last answer, what it predicts, if anything, and iterations of all programs."""
        prediction, iterations = None, 0
        for _ in range(PROGRAMS):
            answer = program.solve_soft(limits, deadline)
            iterations += answer.iterations
            if answer.status != Status.OPTIMAL:
                break
            prediction = program.predict(answer.x)
            added = program.near(prediction.omega) - limits
            if not added or program.excess(prediction.omega) <= OPEN * program.bound:
                break
            limits |= added
        return answer, prediction, iterations
