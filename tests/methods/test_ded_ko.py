"""DED-KO over all points and on knots: solutions replay, statuses are honest, every surrogate serves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods import ded_ko
from ded_bench.methods.ded_ko import build_ded_ko, set_instance
from ded_bench.methods.ed import slow_dispatch
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Artifact, Settings
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import SOLVERS, OnArrays
from ded_bench.solvers.status import Status
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import linear_model
from tests.methods.on_surrogates import METHODS, check_limits, prepared, replay, short

NAMES = ("ded-ko", "ded-ko-knots")


def ways(method) -> list[str]:
    """Options that name a solver, if the method has them."""
    return [f"solver={name}" for name in SOLVERS] if method is ded_ko else ["default"]


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_solvers_agree_and_their_solution_replays_on_the_model(
    case: Case, koopman: Koopman, regime: str
) -> None:
    instance = short(case, 3, horizon_s=2.0)
    solve = [prepared(ded_ko, case, koopman, regime, Settings(f"solver={slug}")) for slug in SOLVERS]
    solutions = [each(instance) for each in solve]
    for solution in solutions:
        check_limits(case, koopman, instance, solution, regime)
        assert solution.iterations > 0
        assert solution.solve_s > 0
        assert solution.solver_objective == pytest.approx(solutions[0].solver_objective, rel=1e-7)
    assert len({solution.solver_version for solution in solutions}) == len(SOLVERS)


@pytest.mark.parametrize("slug", SOLVERS)
def test_reused_model_gives_the_objective_of_a_fresh_one(case: Case, koopman: Koopman, slug: str) -> None:
    """One built model serves all instances."""
    first, last = (short(case, index, horizon_s=1.0) for index in range(2))
    solve = prepared(ded_ko, case, koopman, "TO", Settings(f"solver={slug}"))
    solve(first)
    again = solve(last)
    model = build_ded_ko(case, koopman, last.steps)
    set_instance(model, case, koopman, last, "TO")
    fresh = OnArrays(model, slug).solve()
    # PIQP leaves a relative gap of 1e-7.
    assert again.solver_objective == pytest.approx(fresh.objective, rel=2e-7 if slug == "piqp" else 1e-9)
    assert again.build_s < 0.5  # built before
    assert again.setup_s < 0.5


@pytest.mark.parametrize("method", METHODS)
def test_models_of_other_forms_serve_as_well(method, case: Case, koopman: Koopman) -> None:
    """The paper's form (G = 0) is solved on its own rollout; one more observable changes nothing."""
    instance = short(case, 2, horizon_s=1.0)
    paper = dataclasses.replace(koopman, g=np.zeros_like(koopman.g))
    n = len(koopman.k)
    wider = dataclasses.replace(
        koopman,
        k=np.block([[koopman.k, np.zeros((n, 1))], [np.zeros((1, n)), np.full((1, 1), 0.5)]]),
        b=np.vstack([koopman.b, np.ones((1, koopman.b.shape[1]))]),
        g=np.vstack([koopman.g, np.zeros((1, koopman.g.shape[1]))]),
        lift=np.vstack([koopman.lift, np.ones((1, koopman.lift.shape[1]))]),
    )
    own, plain, more = (prepared(method, case, model, "NO")(instance) for model in (paper, koopman, wider))
    check_limits(case, paper, instance, own, "NO")
    assert more.solver_objective == pytest.approx(plain.solver_objective, rel=1e-7)
    assert own.solver_objective != pytest.approx(plain.solver_objective, rel=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_impossible_instances_are_reported_as_such(method, case: Case, koopman: Koopman) -> None:
    instance = short(case, 0, horizon_s=1.0)
    outside = dict(zip(case.generators, (case.p_max + 0.05).tolist(), strict=True))
    far = instance.model_copy(update={"initial": instance.initial.model_copy(update={"power": outside})})
    spinning = dict.fromkeys(case.generators, 2.0)
    fast = instance.model_copy(update={"initial": instance.initial.model_copy(update={"omega": spinning})})
    for bad, options in [(bad, options) for bad in (far, fast) for options in ways(method)]:
        solution = prepared(method, case, koopman, "NO", Settings(options))(bad)
        assert solution.status == Status.INFEASIBLE
        assert solution.schedule is None
        assert solution.solver_objective is None
        assert solution.error
    assert prepared(method, case, koopman, "NO")(instance).status == Status.OPTIMAL


@pytest.mark.parametrize("method", METHODS)
def test_what_is_only_just_impossible_is_infeasible_too(method, ninebus: Case) -> None:
    """On a model that answers loads a step late, this instance's frequency cannot be held in time."""
    late = linear_model(ninebus)
    late = dataclasses.replace(late, g=np.zeros_like(late.g))
    solution = prepared(method, ninebus, late, "TO")(short(ninebus, 2))
    assert solution.status == Status.INFEASIBLE


@pytest.mark.parametrize("method", METHODS)
def test_initial_power_just_outside_comes_back_in_one_step(method, case: Case, koopman: Koopman) -> None:
    """P_0 is given, wherever it lies; the limits hold from t_1 on."""
    instance = short(case, 0)
    step = case.ramp_pu_per_s * instance.dt_s
    just = dict(zip(case.generators, (case.p_max + 0.5 * step).tolist(), strict=True))
    near = instance.model_copy(update={"initial": instance.initial.model_copy(update={"power": just})})
    solution = prepared(method, case, koopman, "NO")(near)
    assert solution.status == Status.OPTIMAL
    p_gen = solution.schedule.at(instance.grid)
    assert p_gen[0].tolist() == near.p_initial(case).tolist()
    assert (p_gen[1:] - case.p_max).max() <= 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_what_does_not_fit_is_refused(method, case: Case, koopman: Koopman) -> None:
    with pytest.raises(InputError, match=r"has steps of 0\.01"):
        prepared(method, case, koopman, "NO")(short(case, 0, dt_s=0.02))
    with pytest.raises(InputError, match="no such model"):
        method.prepare(case, "NO", Settings(model="nowhere"))


@pytest.mark.parametrize("name", NAMES)
def test_prepare_finds_the_model_that_the_settings_name(name: str, case: Case) -> None:
    settings, instance, method = Settings(model="linear"), short(case, 0), get_method(name)
    assert method.artifacts(case, "NO", settings) == (
        Artifact("model", "linear", linear_model(case).fingerprint),
    )
    solution = method.prepare(case, "NO", settings)(instance)
    check_limits(case, linear_model(case), instance, solution, "NO")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_along_a_trajectory_answers_are_nearly_those_of_the_true_system(
    name: str, regime: str, case: Case
) -> None:
    """Nothing is trained or found in a file; the claim is the scorer's but for the surrogate's error."""
    instance, settings, method = short(case, 2), Settings(model="trajectory"), get_method(name)
    (artifact,) = method.artifacts(case, regime, settings)
    assert (artifact.name, artifact.path) == ("trajectory", None)
    solution = method.prepare(case, regime, settings)(instance)
    assert solution.status == Status.OPTIMAL
    found = score(case, instance, solution.schedule, regime)
    assert found.freq_violation_hz <= 1e-4
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-3)


def test_only_piqp_solves_what_is_made_for_each_instance(ninebus: Case) -> None:
    with pytest.raises(InputError, match="only piqp solves"):
        ded_ko.prepare(ninebus, "NO", Settings("solver=highs", model="trajectory"))


def test_a_lifted_models_knots_answer_as_its_own_rollout(case: Case) -> None:
    instance, surrogate = short(case, 1), linear_model(case)
    points = np.array([0, 40, 41, 120, 300])
    model = surrogate.along(instance, slow_dispatch(case, instance, points), points)
    u = np.random.default_rng(2).normal(scale=0.02, size=model.p_gen.shape)
    u[0] = 0.0
    powers = Schedule(instance.grid[points], model.p_gen + u)
    own = replay(case, surrogate, instance, powers)
    np.testing.assert_allclose(model.outputs(u)[0], own.omega, atol=1e-10)
    np.testing.assert_allclose(model.outputs(u)[1], own.p_slack, atol=1e-9)


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_arrays_are_the_pyomo_model(regime, ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """By default Pyomo holds what is small; without it the optimum is the same (PIQP's gap: 1e-7)."""
    instance, found = short(ninebus, 1), []
    for entries in (ded_ko.PYOMO_ENTRIES, 0):
        monkeypatch.setattr(ded_ko, "PYOMO_ENTRIES", entries)
        solution = ded_ko.prepare(ninebus, regime, Settings(model="linear"))(instance)
        assert solution.status == Status.OPTIMAL
        found.append(solution)
    assert found[0].setup_s > found[1].setup_s == 0  # only a Pyomo model is compiled
    assert found[0].solver_objective == pytest.approx(found[1].solver_objective, rel=2e-7)
