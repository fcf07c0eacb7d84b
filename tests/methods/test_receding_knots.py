"""Knots in repeated solution: they keep their places in time, and the bound keeps a margin."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.methods import ded_ko_knots, receding_knots
from ded_bench.methods.knots import knot_points
from ded_bench.methods.receding_knots import RecedingSolver, receding_points
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import OMEGA_TOLERANCE
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from tests.methods.on_surrogates import replay


def later(schedule: Schedule, seconds: float, horizon_s: float) -> Schedule:
    """A plan on the time of an instance that starts later; its end stays."""
    shifted = schedule.t - seconds
    times = np.concatenate([[0.0], shifted[(shifted > 1e-6) & (shifted < horizon_s - 1e-6)], [horizon_s]])
    return Schedule(times, schedule.at(times + seconds))


def wavy(case: Case, instance: Instance) -> Schedule:
    """A plan that bends at every knot of the case."""
    points = knot_points(case.knot_times(instance.horizon_s), instance.dt_s)
    power = np.random.default_rng(5).normal(size=(len(points), len(case.generators)))
    return Schedule(instance.grid[points], power)


@pytest.mark.parametrize("period_s", [0.1, 1.0, 7.03])
def test_what_the_plan_in_force_goes_on_to_do_is_linear_between_the_knots(case: Case, period_s) -> None:
    """After any number of plans, and their number does not grow."""
    instance = sample_instance(case, 77, 0)
    grid, plan = instance.grid, wavy(case, instance)
    usual = np.diff(case.knot_times(instance.horizon_s))[0]
    for _ in range(40):
        last = later(plan, period_s, instance.horizon_s)
        points = receding_points(case, instance, last)
        assert points[0] == 0
        assert points[-1] == len(grid) - 1
        assert abs(len(points) - case.n_knots) <= 1
        lengths = np.diff(points)[1:] * instance.dt_s
        assert 0.49 * usual <= lengths.min()
        assert lengths.max() <= 1.51 * usual + 2 * instance.dt_s
        restricted = Schedule(grid[points], last.at(grid[points]))
        known = grid <= plan.t[-2] - period_s
        np.testing.assert_allclose(
            restricted.at(grid)[known], plan.at(grid + period_s)[known], rtol=0, atol=1e-9
        )
        power = np.random.default_rng(len(points)).normal(size=restricted.p.shape)
        plan = Schedule(restricted.t, power)


def test_other_plans_give_no_knots(case: Case) -> None:
    """None at all, one of two points, and one with a point at every step."""
    instance = sample_instance(case, 77, 0)
    usual = knot_points(case.knot_times(instance.horizon_s), instance.dt_s)
    n_gen = len(case.generators)
    flat = Schedule(np.array([0.0, instance.horizon_s]), np.ones((2, n_gen)))
    dense = Schedule(instance.grid, np.ones((len(instance.grid), n_gen)))
    for last in (None, flat, dense):
        np.testing.assert_array_equal(receding_points(case, instance, last), usual)


def test_only_plans_in_operation_keep_the_margin(case: Case, koopman) -> None:
    """They are dearer, if anything; a single instance is solved as ever: it may begin beyond the margin."""
    instance, margin = sample_instance(case, 77, 0), 0.25
    rest = instance.initial.model_copy(update={"omega": dict.fromkeys(case.generators, 0.0)})
    instance = instance.model_copy(update={"initial": rest})
    usual = ded_ko_knots.prepare_with(case, koopman, "TO", Settings())(instance)
    solver = RecedingSolver(case, koopman, "TO", margin=margin)
    np.testing.assert_array_equal(solver(instance).schedule.p, usual.schedule.p)
    plan = solver.solve(instance)
    assert plan.status == Status.OPTIMAL
    assert plan.solver_objective >= usual.solver_objective * (1 - 1e-6)
    omega = np.abs(replay(case, koopman, instance, plan.schedule).omega[1:]).max()
    assert omega <= (1 - margin) * case.omega_bound("TO") + 1.1 * OMEGA_TOLERANCE


def test_in_operation_the_plan_in_force_gives_the_knots(ninebus: Case) -> None:
    """By the registry, as the loop asks; the plain answer has the case's knots."""
    method, settings = get_method("ded-ko-knots"), Settings("receding", model="linear")
    solver = method.prepare(ninebus, "TO", settings)
    assert [a.name for a in method.artifacts(ninebus, "TO", settings)] == ["linear"]
    instance = sample_instance(ninebus, 77, 2)
    first = solver(instance).schedule
    np.testing.assert_array_equal(first.t, solver.solve(instance).schedule.t)
    last = later(first, 1.0, instance.horizon_s)
    second = solver.solve(instance, Solution(Status.FEASIBLE, last)).schedule
    ahead = first.t[first.t > 1.0][:-1] - 1.0
    np.testing.assert_allclose(second.t[1 : len(ahead) + 1], ahead, rtol=0, atol=1e-9)
    assert sorted(receding_knots.SETTINGS) == ["receding", "receding-wide"]
