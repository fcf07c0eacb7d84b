"""Free line weights: the linearisation at zero, stable always, exact derivatives; what the fit finds."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.evaluate.rollouts import rollout_table
from ded_bench.koopman.energy_form import injection_lift, steady_state
from ded_bench.koopman.identify import (
    ENERGY_FORM_PARAMETERS,
    held_out,
    identify,
    n_parameters,
    n_training,
)
from ded_bench.koopman.line_fit import fit_lines, sensitivities
from ded_bench.koopman.line_form import Dynamics, LineForm, Step, discretise
from ded_bench.koopman.linear import linear_model
from ded_bench.problem.case import Array, Case


@pytest.fixture(scope="module")
def twoarea() -> Case:
    return Case.load("two-area")


def step_at(form: LineForm, x: Array, step_s: float) -> Step:
    return discretise(form.dynamics(x), steady_state(form.case), step_s)


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus"])
def test_it_starts_at_the_linearisation(name: str) -> None:
    case = Case.load(name)
    form, model = LineForm.make(case), linear_model(case)
    step = step_at(form, np.zeros(form.n_parameters), model.dt_s)
    np.testing.assert_allclose(step.k, model.k, atol=1e-11)
    np.testing.assert_allclose(model.b + step.h, model.g, atol=1e-11)


def test_every_parameter_value_is_stable(twoarea: Case) -> None:
    form, rng = LineForm.make(twoarea), np.random.default_rng(1)
    for draw in range(200):
        x = rng.normal(size=form.n_parameters) * 10.0 ** rng.uniform(-1, 0.5)
        assert np.linalg.eigvals(form.dynamics(x).a).real.max() < 0.0, draw


def test_derivatives_are_those_of_differences(twoarea: Case) -> None:
    """Of A, F, K, H and of whole rollouts, by every parameter."""
    form, rng, size = LineForm.make(twoarea), np.random.default_rng(2), 1e-5
    b, n_out = steady_state(twoarea), len(twoarea.generators) + 1
    x = 0.3 * rng.normal(size=form.n_parameters)
    psi = 0.1 * rng.normal(size=(2, len(b)))
    inputs = np.cumsum(0.01 * rng.normal(size=(30, 2, b.shape[1])), axis=0)

    def everything(x: Array) -> list[Array]:
        step = step_at(form, x, 0.1)
        return [*form.dynamics(x)[:2], step.k, step.h, sensitivities(step, b, psi, inputs, n_out)[0]]

    dynamics, step = form.dynamics(x), step_at(form, x, 0.1)
    jacobian = np.moveaxis(sensitivities(step, b, psi, inputs, n_out)[1], -1, 0)
    exact = [dynamics.da, dynamics.df, step.dk, step.dh, jacobian]
    for j, unit in enumerate(np.eye(form.n_parameters) * size):
        pairs = zip(everything(x + unit), everything(x - unit), exact, strict=True)
        for above, below, derivative in pairs:
            scale = max(np.abs(derivative).max(), 1.0)
            np.testing.assert_allclose((above - below) / (2 * size), derivative[j], atol=1e-7 * scale)


def test_equal_eigenvalues_have_derivatives_too() -> None:
    """A = -I and a change of A to any dA: exp has the derivative exp(-h) h dA, and so on."""
    rng, h = np.random.default_rng(3), 0.2
    da, df = rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3, 2))
    f, b = rng.normal(size=(2, 3, 2))
    step = discretise(Dynamics(-np.eye(3), f, da, df), b, h)
    mean = (1.0 - np.exp(-h)) / h
    np.testing.assert_allclose(step.k, np.exp(-h) * np.eye(3), atol=1e-15)
    np.testing.assert_allclose(step.h, mean * (f - b), atol=1e-15)
    np.testing.assert_allclose(step.dk, np.exp(-h) * h * da, atol=1e-14)
    slope = (mean - np.exp(-h)) / h  # d/dz of (e^z - 1) / z at z = -h
    np.testing.assert_allclose(step.dh, mean * df + h * slope * da @ (f - b), atol=1e-13)


def test_the_fit_finds_the_weights_that_made_the_data(twoarea: Case) -> None:
    """Rollouts of a model with other weights: no error is left, and the model is found again."""
    form, rng = LineForm.make(twoarea), np.random.default_rng(4)
    b, dt_s = steady_state(twoarea), twoarea.sampling.dt_s
    truth = step_at(form, 0.05 * rng.normal(size=form.n_parameters), 10 * dt_s)
    coarse = np.cumsum(0.01 * rng.normal(size=(151, 4, b.shape[1])), axis=0)
    grid = np.arange(1501) / 10
    inputs = np.stack([np.interp(grid, np.arange(151), c) for c in coarse.reshape(151, -1).T], axis=1)
    psi = coarse[0] @ b.T + 0.01 * rng.normal(size=(4, len(b)))
    made = sensitivities(truth, b, psi, coarse, len(twoarea.generators) + 1)[0]
    outputs = np.zeros((1501, *made.shape[1:]))
    outputs[::10] = made
    fit = fit_lines(form, dt_s, psi, inputs.reshape(1501, 4, -1), outputs)
    assert fit.relative_cost < 1e-4
    np.testing.assert_allclose(step_at(form, fit.x, 10 * dt_s).k, truth.k, atol=2e-3)


def test_few_parameters_take_the_energy_form_and_many_the_lines(ninebus: Case, twoarea: Case) -> None:
    assert n_parameters(*steady_state(ninebus).shape) == 46 <= ENERGY_FORM_PARAMETERS
    assert n_parameters(*steady_state(twoarea).shape) == 87 > ENERGY_FORM_PARAMETERS
    assert n_training(ninebus) == 120 > n_training(twoarea)


def test_identified_model_of_a_stressed_grid_beats_the_linearisation(twoarea: Case) -> None:
    model = identify(twoarea, seed=5, count=5)
    assert model.training["relative_cost"] < 1.0
    assert np.abs(np.linalg.eigvals(model.k)).max() < 1.0
    np.testing.assert_array_equal(model.lift, injection_lift(twoarea))
    table = rollout_table(twoarea, [linear_model(twoarea), model], held_out(twoarea, seed=5, count=5))
    mean = table.groupby("model")[["mean max |Δω| (Hz)", "mean RMS ΔP_s (pu)"]].mean()
    assert (mean.loc["koopman"] < 0.5 * mean.loc["linear"]).all()
