"""ADMM of the shared policy: its quadratic model, its optimum, its derivatives, against independent ones."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
import torch

from ded_bench.methods.admm.grid_response import FINE
from ded_bench.methods.admm.iteration_kernels import modal_change
from ded_bench.methods.admm.mode_kernels import interval_maps, oscillators
from ded_bench.methods.admm.path_model import Linear, Outset, PathModel
from ded_bench.methods.admm.plant_gradient import ModalChange, Transposed
from ded_bench.methods.admm.admm_inference import (
    CompiledIterations,
    mean_modes_of,
    settings_of,
    starting_settings,
    weight_shapes,
)
from ded_bench.methods.admm.admm_iterations import UnrolledIterations
from ded_bench.problem.case import Array, Case
from tests.methods.test_dpc_shared import drawn, linearised, path_model


@pytest.mark.parametrize("square", [-2.0, 0.0, 0.01, 4.0, 400.0, 1e6])
def test_oscillators_are_matrix_exponentials(square: float) -> None:
    """Against scipy's of the system with value and slope of its input as states."""
    rate, h = 0.3, 0.3
    generator = np.zeros((4, 4))
    generator[0, 1] = generator[1, 2] = generator[2, 3] = 1.0
    generator[1, :2] = -square, -rate
    exact = scipy.linalg.expm(generator * h)
    (found,) = oscillators(np.array([square]), rate, h)
    expected = np.column_stack([exact[:2, :2], exact[:2, 2] - exact[:2, 3] / h, exact[:2, 3] / h])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_quadratic_model_is_minimised_by_its_recursion() -> None:
    """Against the dense normal equations, with responses by scipy."""
    rng, n, h, rate = np.random.default_rng(0), 12, 0.1, 0.3
    squares, outputs = np.array([3.0, 60.0]), np.array([[0.6, 2.0], [1.7, 0.2]])
    weights, gradient = np.array([0.2, 0.5, 7.0, 3.0]), rng.standard_normal((n, 2))
    found = np.empty_like(gradient)
    modal_change(interval_maps(oscillators(squares, rate, h), FINE), outputs, weights, gradient, found)
    times, knots = h * np.arange(FINE * (n - 1) + 1), h * FINE * np.arange(n)
    for m in range(2):
        system = scipy.signal.StateSpace([[0, 1], [-squares[m], -rate]], [[0], [1]], np.eye(2), [[0], [0]])
        hats = [np.interp(times, knots, row) for row in np.eye(n)[1:]]
        responses = np.stack([scipy.signal.lsim(system, hat, times)[1] for hat in hats], axis=2)
        changes = np.diff(np.eye(n), axis=0)[:, 1:]
        matrix = weights[0] * np.eye(n - 1) + weights[1] * changes.T @ changes
        matrix += weights[2] * outputs[0, m] * responses[:, 1].T @ responses[:, 1]
        matrix += weights[3] * outputs[1, m] * responses[:, 0].T @ responses[:, 0]
        np.testing.assert_allclose(found[1:, m], -np.linalg.solve(matrix, gradient[1:, m]), rtol=1e-8)
    assert (found[0] == 0.0).all()


def test_mean_modes_say_what_a_mode_does_alone(case: Case) -> None:
    """Against the response to one mode's constant powers, from rest, where stiffness keeps its mean."""
    model = path_model(case)
    outset = drawn(model, 1)
    linear = linearised(model, outset)
    mean = mean_modes_of(model, linear)
    network = model.response.network
    into, maps, outputs = (part[0] for part in mean)
    share = np.gradient(model.response.instants.astype(float)) * np.array([0.5, *[1.0] * 3, 0.5])
    stiffness = model.response.stiffness + np.average(linear.stiffness[0], axis=0, weights=share)
    h, n_gen = float(model.response.fine[1]), len(network.m)
    inverse = 1.0 / network.m
    for m in range(n_gen):
        system = np.zeros((2 * n_gen + 1, 2 * n_gen + 1))
        system[:n_gen, n_gen : 2 * n_gen] = np.eye(n_gen)
        system[n_gen:-1, :n_gen] = -inverse[:, None] * stiffness
        system[n_gen:-1, n_gen:-1] = -model.response.rate * np.eye(n_gen)
        system[n_gen:-1, -1] = inverse * into[:, m]
        state = scipy.linalg.expm(system * FINE * h)[:-1, -1]  # x and ω after one interval between knots
        q, speed = maps[FINE, :, 2, m] + maps[FINE, :, 3, m]
        assert outputs[0, m] * speed**2 == pytest.approx((state[n_gen:] ** 2).sum(), rel=1e-6)
        assert outputs[1, m] * q**2 == pytest.approx((stiffness @ state[:n_gen]).sum() ** 2, rel=1e-6)


def test_derivatives_of_the_quadratic_model_by_differences(case: Case) -> None:
    """In the gradient and the weights, in double precision through `modal_change`; float32 leaves 1e-3."""
    model = path_model(case)
    outset = drawn(model, 2)
    modes = mean_modes_of(model, linearised(model, outset))
    torch.manual_seed(0)
    gradient = torch.randn(outset.start.shape, requires_grad=True)
    weights = torch.tensor([0.5, 2.0, 3.0, 0.2], requires_grad=True)
    toward = torch.randn(outset.start.shape)

    def value() -> torch.Tensor:
        return (ModalChange.apply(gradient, weights, modes).double() * toward).sum()

    value().backward()
    for tensor in (gradient, weights):
        direction = torch.randn_like(tensor)
        along, size = float((tensor.grad * direction).sum()), 1e-2
        with torch.no_grad():
            tensor.add_(size * direction)
            above = float(value())
            tensor.sub_(2 * size * direction)
            below = float(value())
            tensor.add_(size * direction)
        assert (above - below) / (2 * size) == pytest.approx(along, rel=2e-3, abs=1e-3 * abs(above))


def test_transposed_response_and_the_response_are_each_others_gradient(case: Case) -> None:
    """⟨Hᵀ y, x⟩ and ⟨y, H x⟩, the second by the gradient of the first; float32."""
    model = path_model(case)
    outset = drawn(model, 2)
    linear = linearised(model, outset)
    torch.manual_seed(0)
    on_omega = torch.randn(2, len(model.response.fine), len(case.generators), requires_grad=True)
    on_slack = torch.randn(2, len(model.response.fine), requires_grad=True)
    powers = torch.randn(outset.start.shape)
    powers[:, 0] = 0.0
    product = (Transposed.apply(on_omega, on_slack, model, linear) * powers).sum()
    product.backward()
    before = model.respond(outset.start, outset, linear)
    after = model.respond(outset.start + powers.double().numpy(), outset, linear)
    size = float(np.abs(after[1] - before[1]).max())
    np.testing.assert_allclose(on_omega.grad.numpy(), after[1] - before[1], atol=1e-5 * size)
    np.testing.assert_allclose(
        on_slack.grad.numpy(), after[2] - before[2], atol=1e-5 * float(np.abs(after[2] - before[2]).max())
    )


def optimum(model: PathModel, outset: Outset, linear: Linear) -> float:
    """Least mean cost along the path of a single problem, by HiGHS over the dense response."""
    n, n_gen = outset.start.shape[1:]
    base = np.repeat(outset.problems.p_initial[:, None], n, axis=1)
    _, free, slack = (part[0] for part in model.respond(base, outset, linear))
    columns = []
    for j in range(1, n):
        for g in range(n_gen):
            moved = base.copy()
            moved[0, j, g] += 1.0
            _, omega, p_slack = (part[0] for part in model.respond(moved, outset, linear))
            columns.append(np.concatenate([(omega - free).ravel(), p_slack - slack]))
    response = np.stack(columns, axis=1)
    speeds, slacks = response[: free.size], response[free.size :]
    n_fine, (case, cost) = len(slack), (model.case, outset.problems.cost[0])
    at_knots, at_fine = mean_weights(n), mean_weights(n_fine)
    ramps = np.kron(np.diff(np.eye(n), axis=0)[:, 1:], np.eye(n_gen))
    rows = [
        np.hstack([sign * part, np.zeros((len(part), n_fine))])
        for part in (speeds, ramps)
        for sign in (1, -1)
    ]
    rows += [np.hstack([sign * slacks, -np.eye(n_fine)]) for sign in (1, -1)]
    steps = np.tile(model.ramp, n - 1)
    right = [model.bound - free.ravel(), model.bound + free.ravel(), steps, steps, -slack, slack]
    below = np.tile(case.p_min - base[0, 0], n - 1)
    above = np.tile(case.p_max - base[0, 0], n - 1)
    bounds = [*zip(below, above, strict=True), *[(0.0, None)] * n_fine]
    price = np.concatenate([(at_knots[1:, None] * cost[1:]).ravel(), cost[0] * at_fine])
    found = scipy.optimize.linprog(price, np.vstack(rows), np.concatenate(right), bounds=bounds)
    assert found.success
    return float(found.fun + base[0, 0] @ cost[1:])


def mean_weights(n: int) -> Array:
    weights = np.full(n, 1.0 / (n - 1))
    weights[[0, -1]] *= 0.5
    return weights


def test_many_iterations_find_the_optimum(threebus: Case) -> None:
    """What a dozen iterations approach is the optimum of the linear program: 0.1 %, within the bound."""
    model = path_model(threebus)
    for seed in range(3):
        outset = drawn(model, 1, seed)
        linear = linearised(model, outset)
        answer = CompiledIterations(model, zero_weights(), 4000)(outset, linear, outset.start)
        _, omega, p_slack = model.respond(answer, outset, linear)
        cost = outset.problems.cost[0]
        found = mean_weights(answer.shape[1]) @ (answer[0] @ cost[1:])
        found += cost[0] * mean_weights(p_slack.shape[1]) @ np.abs(p_slack[0])
        least = optimum(model, outset, linear)
        assert found == pytest.approx(least, rel=1e-3)
        assert np.abs(omega).max() < 1.002 * model.bound


def zero_weights() -> dict[str, np.ndarray]:
    return {name: np.zeros(shape, np.float32) for name, shape in weight_shapes().items()}


def test_weights_move_settings_within_their_range(ninebus: Case) -> None:
    """0 is where training starts; whatever the weights are, penalties are positive, and torch agrees."""
    np.testing.assert_array_equal(settings_of(zero_weights()["nodes"], 9), starting_settings(9))
    torch.manual_seed(0)
    unrolled = UnrolledIterations(path_model(ninebus), 9)
    with torch.no_grad():
        unrolled.nodes.add_(3.0 * torch.randn_like(unrolled.nodes))
    found = settings_of(unrolled.nodes.detach().numpy(), 9)
    np.testing.assert_allclose(unrolled.settings().detach().numpy(), found, rtol=1e-4)
    assert (found > 0.0).all()
    assert (found[:, 6] < 2.0).all()
    assert (found[:, 7] < 0.1).all()
