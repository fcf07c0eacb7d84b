"""Corrections of the shared policy's answers: the program, and what holds for any weights."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ded_bench.methods import ded_slp
from ded_bench.methods.dpc_shared import shared_refined
from ded_bench.methods.dpc_shared.path_model import Outset, PathModel
from ded_bench.methods.dpc_shared.path_program import PathProgram
from ded_bench.methods.dpc_shared.shared_refined import SPACING_S, knots_between, prepare
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.solvers.highs import solve_form as solve_by_highs
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status
from ded_bench.truth.score import score
from tests.methods.test_dpc_shared import (
    drawn,
    in_operation,
    linearised,
    path_model,
    random_policy,
    short_instance,
)

#: The program keeps nearly all of the bound; what the linearised grid leaves out is not its concern here.
BOUND = 0.99


def program(model: PathModel, outset: Outset, knots: int, bound: float = BOUND) -> PathProgram:
    linear = linearised(model, outset)
    return PathProgram(model, outset, linear, outset.start, knots, bound * model.bound)


def test_program_says_what_the_linearised_grid_does(case: Case) -> None:
    """At any point of its columns that keeps its equations: the states follow from the corrections."""
    model = path_model(case)
    outset = drawn(model, 1)
    linear = linearised(model, outset)
    for knots in (1, knots_between(model.response.knots)):
        ours = PathProgram(model, outset, linear, outset.start, knots, model.bound)
        everywhere = ours.near(-1.0)
        form = ours.form(everywhere)
        count, n_gen = everywhere.shape[0], everywhere.shape[2]
        step = 0.1 * np.random.default_rng(0).uniform(-1.0, 1.0, (count, n_gen)) * (case.p_max - case.p_min)
        x = np.zeros(len(form.cost))
        _, _, corrections, states = ours.columns(False)
        x[corrections], states = step, states.ravel()
        x[states] = np.linalg.solve(form.equal[:, states].toarray(), -form.equal @ x)
        powers = ours.corrected(x)
        _, omega, p_slack = model.respond(powers, outset, linear)
        limits = omega[0, 1:].size
        told = (form.between @ x)[-limits:] - form.high[-limits:] + model.bound
        np.testing.assert_allclose(told, omega[0, 1:].ravel(), atol=1e-9 * max(1.0, np.abs(omega).max()))
        pieces = count * knots
        slack = (form.between @ x)[count * n_gen :][:pieces] - form.high[count * n_gen :][:pieces]
        means = p_slack[0, 1:].reshape(pieces, -1).mean(axis=1)
        np.testing.assert_allclose(slack, means, atol=1e-9 * max(1.0, np.abs(p_slack).max()))


def test_optimum_agrees_with_an_independent_solver(case: Case) -> None:
    model = path_model(case)
    ours = program(model, drawn(model, 1, seed=3), knots_between(model.response.knots))
    form = ours.form(ours.near(0.5))
    found, other = solve_form(form, staged=True, regularisation=1e-9), solve_by_highs(form)
    assert found.status == other.status == Status.OPTIMAL
    scale = np.abs(form.cost * other.x).sum()
    assert form.cost @ found.x == pytest.approx(form.cost @ other.x, abs=1e-5 * scale)


def test_limits_that_cannot_hold_are_widened(ninebus: Case) -> None:
    model = path_model(ninebus)
    outset = drawn(model, 1)
    tight = program(model, outset, knots_between(model.response.knots), bound=1e-5)
    everywhere = tight.near(-1.0)
    assert solve_form(tight.form(everywhere), staged=True, regularisation=1e-9).status != Status.OPTIMAL
    answer = solve_form(tight.form(everywhere, widened=True), staged=True, regularisation=1e-9)
    assert answer.status == Status.OPTIMAL
    powers = tight.corrected(answer.x, widened=True)
    assert powers.shape == outset.start.shape


def test_every_knot_is_corrected_where_fewer_corrections_have_no_solution(
    ninebus: Case, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    policy, path = random_policy(ninebus), tmp_path / "p.safetensors"
    policy.save(path)
    solve = prepare(ninebus, policy.scope.regime, Settings(policy=path))
    instance = short_instance(ninebus)
    finest, sizes = solve(instance).schedule, []

    def one_fails(form, **options):
        sizes.append(len(form.cost))
        answer = solve_form(form, **options)
        return dataclasses.replace(answer, status=Status.FAILED) if len(sizes) == 1 else answer

    monkeypatch.setattr(shared_refined, "solve_form", one_fails)
    monkeypatch.setattr(shared_refined, "knots_between", lambda knots: len(knots) - 1)
    np.testing.assert_array_equal(solve(instance).schedule.p, finest.p)
    assert sizes[0] < sizes[1]


def test_one_correction_for_so_many_knots() -> None:
    assert knots_between(np.linspace(0.0, 60.0, 50)) == 1
    assert knots_between(np.linspace(0.0, 60.0, 151)) == 3
    assert knots_between(np.linspace(0.0, 60.0, 60)) == 1  # 59 intervals
    assert int(SPACING_S / 0.5) == knots_between(np.linspace(0.0, 60.0, 121)) == 2


@pytest.mark.parametrize("settings", list(shared_refined.SETTINGS))
def test_limits_hold_exactly_from_any_state(case: Case, settings: str, tmp_path: Path) -> None:
    policy, path = random_policy(case), tmp_path / "p.safetensors"
    policy.save(path)
    solve = prepare(case, policy.scope.regime, Settings(settings, policy=path))
    for instance in (short_instance(case), in_operation(case, 1)):
        schedule = solve(instance).schedule
        assert schedule is not None
        assert np.array_equal(schedule.p[0], instance.p_initial(case))
        assert (schedule.p >= case.p_min).all()
        assert (schedule.p <= case.p_max).all()
        step = case.ramp * np.diff(schedule.t)[:, None]
        assert (np.abs(np.diff(schedule.p, axis=0)) <= step + 1e-12).all()


def test_bad_weights_cost_little(ninebus: Case, tmp_path: Path) -> None:
    """From what random weights answer, corrections lead as near to the optimum as the knots allow."""
    policy, path = random_policy(ninebus, 0.3, ninebus.sampling.horizon_s), tmp_path / "p.safetensors"
    policy.save(path)
    solve = prepare(ninebus, "TO", Settings(policy=path))
    optimal = ded_slp.prepare(ninebus, "TO", Settings())
    for index in range(3):
        instance = sample_instance(ninebus, VALIDATION_SEED, index)
        ours, best = (
            score(ninebus, instance, method(instance).schedule, "TO") for method in (solve, optimal)
        )
        assert ours.feasible
        assert ours.objective < 1.004 * best.objective  # 5 % of the bound are left, and knots are 1.2 s apart
