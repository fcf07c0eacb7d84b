"""Real-time iterations: soft limits, rows and linearisation from the plan in force, a margin in operation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ded_bench.run.bench import timed
from ded_bench.surrogates.energy_form import injection_lift
from ded_bench.surrogates.linear import linear_model
from ded_bench.methods import ded_ko_knots
from ded_bench.methods.real_time_knots import GAP, OPEN, RealTimeSolver
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.solvers.status import Status
from ded_bench.plants.score import score
from tests.methods.on_surrogates import replay, short
from tests.methods.test_ded_ko_knots import least_excess


def at_rest(case: Case, instance: Instance) -> Instance:
    """The same, with frequencies inside of any margin."""
    rest = instance.initial.model_copy(update={"omega": dict.fromkeys(case.generators, 0.0)})
    return instance.model_copy(update={"initial": rest})


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_soft_limits_do_not_change_the_optimum(case: Case, koopman, regime: str) -> None:
    """A lifted model is the same along every plan; where limits can hold, the penalty is exact."""
    for index in range(3):
        instance = at_rest(case, short(case, index))
        hard = ded_ko_knots.prepare_with(case, koopman, regime, Settings())(instance)
        soft = RealTimeSolver(case, koopman, regime, 0.25)(instance)
        assert (hard.status, soft.status) == (Status.OPTIMAL, Status.FEASIBLE)
        # Programs stop at a relative duality gap of GAP.
        assert soft.solver_objective == pytest.approx(hard.solver_objective, rel=GAP)


def test_plans_in_operation_keep_the_margin(case: Case, koopman) -> None:
    margin, instance = 0.25, at_rest(case, sample_instance(case, 77, 0))
    solver = RealTimeSolver(case, koopman, "TO", margin)
    single, plan = solver(instance), solver.solve(instance)
    assert plan.status == Status.FEASIBLE
    assert plan.solver_objective >= single.solver_objective * (1 - GAP)
    omega = np.abs(replay(case, koopman, instance, plan.schedule).omega[1:]).max()
    assert omega <= (1 - margin) * case.omega_bound("TO") * (1 + 1.1 * OPEN)


def test_what_is_infeasible_is_exceeded_little(ninebus: Case) -> None:
    """A start beyond the bound: the plan says so, and its total excess is nearly the least there is."""
    koopman = dataclasses.replace(linear_model(ninebus), lift=injection_lift(ninebus))
    bound, instance = ninebus.omega_bound("TO"), short(ninebus, 0)
    beyond = instance.initial.model_copy(update={"omega": dict.fromkeys(ninebus.generators, 1.2 * bound)})
    instance = instance.model_copy(update={"initial": beyond})
    plan = RealTimeSolver(ninebus, koopman, "TO", 0.0).solve(instance)
    assert (plan.status, plan.solver_objective) == (Status.INFEASIBLE, None)
    first = np.rint(plan.schedule.t[:-1] / instance.dt_s).astype(int)
    over = np.abs(replay(ninebus, koopman, instance, plan.schedule).omega).max(axis=1) - bound
    total = np.maximum(np.maximum.reduceat(over[1:], first), 0.0).sum()
    assert total == pytest.approx(least_excess(ninebus, koopman, instance, "TO"), rel=0.02)


def test_the_plan_in_force_saves_programs_and_model_error() -> None:
    """On two-area, where plans swing far from the static dispatch: fewer iterations, and a smaller excess."""
    case = Case.load("two-area")
    instance, settings = sample_instance(case, VALIDATION_SEED, 0), Settings("real-time", model="trajectory")
    solver = get_method("ded-ko-knots").prepare(case, "TO", settings)
    cold = solver.solve(at_rest(case, instance))
    warm = solver.solve(at_rest(case, instance), Solution(Status.FEASIBLE, cold.schedule))
    assert warm.iterations < 0.7 * cold.iterations
    usual = ded_ko_knots.prepare(case, "TO", Settings(model="trajectory"))(instance)
    excess = [score(case, instance, plan.schedule, "TO") for plan in (usual, solver(instance))]
    assert excess[1].freq_violation_hz < 0.2 * excess[0].freq_violation_hz


def test_build_and_solution_times_are_those_of_one_step(ninebus: Case) -> None:
    """So that `bench` times what operation asks for; the step before is set-up."""
    solver = get_method("ded-ko-knots").prepare(ninebus, "TO", Settings("real-time", model="linear"))
    call = timed(solver, sample_instance(ninebus, 77, 2))
    parts = call.solution.build_s, call.solution.setup_s, call.solution.solve_s
    assert min(parts) > 0
    assert sum(parts) == pytest.approx(call.seconds, rel=0.2)


def test_a_time_limit_is_kept(ninebus: Case) -> None:
    settings = Settings("real-time", model="linear", time_limit_s=1e-4)
    solution = get_method("ded-ko-knots").prepare(ninebus, "NO", settings)(sample_instance(ninebus, 77, 0))
    assert (solution.status, solution.schedule) == (Status.TIME_LIMIT, None)
