"""Learned ADMM: its quadratic model, its optimum, its derivatives, its loss, against independent ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
import torch

from ded_bench.files.errors import InputError
from ded_bench.methods import ded_slp
from ded_bench.methods.admm import admm_training
from ded_bench.methods.admm.admm_inference import (
    CompiledIterations,
    mean_modes_of,
    settings_of,
    starting_settings,
)
from ded_bench.methods.admm.admm_policy import prepare
from ded_bench.methods.admm.admm_training import with_margin
from ded_bench.methods.admm.modal_kernels import SLOWEST, interval_maps, modal_change, oscillators
from ded_bench.methods.admm.problems import POINTS, problems_of
from ded_bench.methods.admm.torch_iterations import ModalChange, TorchIterations, Transposed, judged
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.plants.plant import simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from tests.methods.policies import modal_grid, random_policy, short_instances, started, torch_iterations


@pytest.mark.parametrize("square", [-2.0, 0.0, 0.01, 0.0225, 4.0, 400.0, 1e6])
def test_oscillators_are_matrix_exponentials(square: float) -> None:
    """Against scipy's of the system with value and slope of its input as states; critically damped, too."""
    rate, h = 0.3, 0.3
    generator = np.zeros((4, 4))
    generator[0, 1] = generator[1, 2] = generator[2, 3] = 1.0
    generator[1, :2] = -square, -rate
    exact = scipy.linalg.expm(generator * h)
    (found,) = oscillators(np.array([square]), rate, h)
    expected = np.column_stack([exact[:2, :2], exact[:2, 2] - exact[:2, 3] / h, exact[:2, 3] / h])
    # a smallest square stands for 0: angles differ by half of it times h², speeds by it times h
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 if square else SLOWEST * h)


def test_quadratic_model_is_minimised_by_its_recursion() -> None:
    """Against the dense normal equations, with responses by scipy."""
    rng, n, h, rate = np.random.default_rng(0), 12, 0.1, 0.3
    squares, outputs = np.array([3.0, 60.0]), np.array([[0.6, 2.0], [1.7, 0.2]])
    weights, gradient = np.array([0.2, 0.5, 7.0, 3.0]), rng.standard_normal((n, 2))
    found = np.empty_like(gradient)
    modal_change(interval_maps(oscillators(squares, rate, h), POINTS), outputs, weights, gradient, found)
    times, knots = h * np.arange(POINTS * (n - 1) + 1), h * POINTS * np.arange(n)
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
    grid = modal_grid(case)
    _, linear = started(grid, 1)
    mean = mean_modes_of(grid, linear)
    network = grid.network
    into, maps, outputs = (part[0] for part in mean)
    share = np.gradient(grid.stiffness_knots.astype(float)) * np.array([0.5, *[1.0] * 3, 0.5])
    stiffness = grid.stiffness + np.average(linear.stiffness[0], axis=0, weights=share)
    h, n_gen = float(grid.points[1]), len(network.m)
    inverse = 1.0 / network.m
    for m in range(n_gen):
        system = np.zeros((2 * n_gen + 1, 2 * n_gen + 1))
        system[:n_gen, n_gen : 2 * n_gen] = np.eye(n_gen)
        system[n_gen:-1, :n_gen] = -inverse[:, None] * stiffness
        system[n_gen:-1, n_gen:-1] = -grid.rate * np.eye(n_gen)
        system[n_gen:-1, -1] = inverse * into[:, m]
        state = scipy.linalg.expm(system * POINTS * h)[:-1, -1]  # x and ω after one interval between knots
        q, speed = maps[POINTS, :, 2, m] + maps[POINTS, :, 3, m]
        assert outputs[0, m] * speed**2 == pytest.approx((state[n_gen:] ** 2).sum(), rel=1e-6)
        assert outputs[1, m] * q**2 == pytest.approx((stiffness @ state[:n_gen]).sum() ** 2, rel=1e-6)


def test_derivatives_of_the_quadratic_model_by_differences(case: Case) -> None:
    """In the gradient and the weights, in double precision through `modal_change`; float32 leaves 1e-3."""
    grid = modal_grid(case)
    start, linear = started(grid, 2)
    modes = mean_modes_of(grid, linear)
    torch.manual_seed(0)
    gradient = torch.randn(start.schedule.shape, requires_grad=True)
    weights = torch.tensor([0.5, 2.0, 3.0, 0.2], requires_grad=True)
    toward = torch.randn(start.schedule.shape)

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
    grid = modal_grid(case)
    start, linear = started(grid, 2)
    torch.manual_seed(0)
    on_omega = torch.randn(2, len(grid.points), len(case.generators), requires_grad=True)
    on_slack = torch.randn(2, len(grid.points), requires_grad=True)
    powers = torch.randn(start.schedule.shape)
    powers[:, 0] = 0.0
    product = (Transposed.apply(on_omega, on_slack, grid, linear) * powers).sum()
    product.backward()
    before = grid.respond(start.schedule, start, linear)
    after = grid.respond(start.schedule + powers.double().numpy(), start, linear)
    size = float(np.abs(after[1] - before[1]).max())
    np.testing.assert_allclose(on_omega.grad.numpy(), after[1] - before[1], atol=1e-5 * size)
    np.testing.assert_allclose(
        on_slack.grad.numpy(), after[2] - before[2], atol=1e-5 * float(np.abs(after[2] - before[2]).max())
    )


def test_weights_move_settings_within_their_range(ninebus: Case) -> None:
    """0 is where training starts; whatever the weights are, penalties are positive, and torch agrees."""
    np.testing.assert_array_equal(settings_of(np.zeros((4, 8)), 9), starting_settings(9))
    torch.manual_seed(0)
    network = TorchIterations(modal_grid(ninebus), 9)
    with torch.no_grad():
        network.nodes.add_(3.0 * torch.randn_like(network.nodes))
    found = settings_of(network.nodes.detach().numpy(), 9)
    np.testing.assert_allclose(network.settings().detach().numpy(), found, rtol=1e-4)
    assert (found > 0.0).all()
    assert (found[:, 6] < 2.0).all()
    assert (found[:, 7] < 0.1).all()


def test_compiled_iterations_are_those_of_torch(case: Case) -> None:
    grid = modal_grid(case)
    (start, _), network = started(grid), torch_iterations(grid)
    with torch.no_grad():
        expected = network(start)[0].double().numpy()
    found = random_policy("ded-admm", case).powers(start.problems)
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_loss_is_the_scorers(ninebus: Case) -> None:
    """Cost within 0.05 %, largest excess within 2 % of the bound, of what the simulation says."""
    grid = modal_grid(ninebus, 60.0)
    instance = sample_instance(ninebus, POLICY_SEED, 7)
    start = grid.start(problems_of(ninebus, [instance], grid.points))
    outcome = grid.respond(start.schedule, start, grid.along_first(start))
    tensors = [torch.as_tensor(part, dtype=torch.float32) for part in (start.schedule, *outcome[1:])]
    found, _, most = judged(grid, start, (tensors[0], tensors[1], tensors[2]))
    truth = score(ninebus, instance, Schedule(grid.knots, start.schedule[0]), "TO")
    cost = float(found[0] * start.scale[0]) * len(instance.grid)
    assert cost == pytest.approx(truth.objective, rel=5e-4)
    excess = truth.freq_violation_hz * 2 * np.pi / grid.bound
    assert float(most[0]) == pytest.approx(excess, abs=0.02)


def test_a_surrogate_is_refused(ninebus: Case, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="without a surrogate"):
        admm_training.train(ninebus, "TO", [], tmp_path / "p.safetensors", TrainingOptions(model="linear"))


def test_margin_is_the_least_that_makes_enough_schedules_feasible(
    ninebus: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = random_policy("ded-admm", ninebus)
    instances = short_instances(ninebus, 4)
    margins = (0.0, 0.3, 0.6)
    shares = []
    for margin in margins:
        tried = dataclasses.replace(policy, training=policy.training | {"margin": margin})
        pairs = zip(instances, tried(instances), strict=True)
        shares.append(np.mean([score(ninebus, i, s, policy.scope.regime).feasible for i, s in pairs]))
    monkeypatch.setattr(admm_training, "MARGINS", margins)
    for wanted in (0.0, *shares, 2.0):
        monkeypatch.setattr(admm_training, "WANTED", wanted)
        chosen = with_margin(policy, instances).training
        enough = [margin for margin, share in zip(margins, shares, strict=True) if share >= wanted]
        best = margins[int(np.argmax(shares))]
        assert chosen["margin"] == (enough[0] if enough else best)
        assert chosen["margin_feasible"] == shares[margins.index(chosen["margin"])]


def test_without_training_eighty_iterations_are_near_the_optimum(ninebus: Case, tmp_path: Path) -> None:
    """From where training starts: within 0.5 % of `ded-slp`, and feasible."""
    policy, path = random_policy("ded-admm", ninebus, 0.0, 60.0), tmp_path / "p.safetensors"
    policy.save(path)
    solve = prepare(ninebus, "TO", Settings("iterations=80", policy=path))
    optimal = ded_slp.prepare(ninebus, "TO", Settings())
    for index in range(2):
        instance = sample_instance(ninebus, VALIDATION_SEED, index)
        ours, best = (score(ninebus, instance, one(instance).schedule, "TO") for one in (solve, optimal))
        assert ours.feasible
        assert ours.objective < 1.005 * best.objective


def test_margin_is_left_free_of_the_bound(ninebus: Case, tmp_path: Path) -> None:
    """Where the bound binds, the largest |ω| is lower by the margin, and the cost is higher."""
    policy, path = random_policy("ded-admm", ninebus, 0.0, 60.0), tmp_path / "p.safetensors"
    policy.save(path)
    bound, found = ninebus.omega_bound("TO"), []
    instance = sample_instance(ninebus, VALIDATION_SEED, 2)  # starts slowly
    for options in ("iterations=80", "iterations=80,margin=0.3"):
        schedule = prepare(ninebus, "TO", Settings(options, policy=path))(instance).schedule
        largest = np.abs(simulate(ninebus, instance, schedule).omega[1:]).max()
        found.append((largest / bound, score(ninebus, instance, schedule, "TO").objective))
    (near, cheap), (far, dear) = found
    assert near > 0.9
    assert far < 0.75
    assert dear > cheap


@pytest.mark.parametrize(("case", "options"), [("9bus", "margin=1"), ("two-area-agc", "margin=0.1")])
def test_margin_is_refused_where_there_is_none(case: str, options: str) -> None:
    with pytest.raises(InputError, match="margin"):
        get_method("ded-admm").prepare(Case.load(case), "TO", Settings(options))


def test_weights_learned_for_few_iterations_do_not_serve_many(ninebus: Case) -> None:
    """A policy of less than ten iterations answers with its weights; those where training starts follow."""
    policy = random_policy("ded-admm", ninebus)
    for iterations, few in ((6, True), (12, False)):
        changed = dataclasses.replace(policy, training=policy.training | {"iterations": iterations})
        untrained = CompiledIterations(changed.grid, changed.grid.bound, np.zeros((4, 8)), 80)
        ratio = changed.further(80).settings / untrained.settings
        assert np.allclose(ratio[:, 4:], 1.0) == few


def test_what_is_not_finite_is_not_answered(ninebus: Case) -> None:
    """Iterations that swing up without end leave the first schedule."""
    policy = random_policy("ded-admm", ninebus)
    start, linear = started(policy.grid, 2)
    linear.offset[1] = np.nan
    iterations = CompiledIterations(policy.grid, policy.grid.bound, policy.weights["nodes"], 3)
    found = iterations(start, linear, start.schedule)
    np.testing.assert_array_equal(found[1], start.schedule[1])
    assert not np.array_equal(found[0], start.schedule[0])
