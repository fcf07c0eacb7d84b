"""Learned ADMM: its quadratic model, iterations, optimum and loss, against independent ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal

from ded_bench.files.errors import InputError
from ded_bench.methods import ded_slp
from ded_bench.methods.admm import admm_training
from ded_bench.methods.admm.admm_inference import (
    DOUBLING,
    PRICE,
    STRAIGHT,
    CompiledIterations,
    limits_of,
    mean_modes_of,
    schedule_loss,
    settings_of,
    starting_settings,
)
from ded_bench.methods.admm.admm_policy import prepare
from ded_bench.methods.admm.admm_training import read_start, with_margin
from ded_bench.methods.admm.modal_kernels import interval_maps, modal_change, oscillators
from ded_bench.methods.admm.problems import POINTS, Problems
from ded_bench.methods.policy_file import write_policy
from ded_bench.methods.ramp_follower import track
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.plants.score import score
from ded_bench.plants.simulate import simulate
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from tests.methods.policies import (
    modal_grid,
    random_policy,
    short_instances,
    started,
)


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


def test_weights_move_settings_within_their_range() -> None:
    """0 is where training starts; whatever the weights are, penalties are positive."""
    np.testing.assert_array_equal(settings_of(np.zeros((4, 8)), 9), starting_settings(9))
    found = settings_of(3.0 * np.random.default_rng(0).standard_normal((4, 8)), 9)
    assert (found > 0.0).all()
    assert (found[:, 6] < 2.0).all()
    assert (found[:, 7] < 0.1).all()


def test_iterations_are_those_of_admm(case: Case) -> None:
    """Written out with dense matrices: response by columns, and its transpose; float32 leaves 1e-5."""
    grid = modal_grid(case)
    (start, linear), rng = started(grid, 2), np.random.default_rng(1)
    nodes, rounds = 0.3 * rng.standard_normal((4, 8)), 3
    iterate = CompiledIterations(grid, grid.bound, nodes, rounds, only_better=False)
    found = iterate(start, linear, start.schedule)
    limits, (into, maps, outputs) = limits_of(grid, grid.bound), mean_modes_of(grid, linear)
    n, n_gen, n_points = *start.schedule.shape[1:], len(grid.points)

    def respond(p: np.ndarray) -> np.ndarray:
        """All that is limited or priced, one after another: powers, changes, ω, P_s, of both problems."""
        _, omega, p_slack = grid.respond(p, start, linear)
        parts = p[:, 1:], np.diff(p, axis=1), omega, p_slack
        return np.concatenate([part.reshape(2, -1) for part in parts], axis=1)

    unit, rest = np.eye(n * n_gen).reshape(-1, n, n_gen), respond(np.zeros_like(start.schedule))
    columns = np.stack([respond(np.stack([one, one])) - rest for one in unit], axis=2)
    sizes = [(n - 1) * n_gen] * 2 + [n_points * n_gen, n_points]
    bound, step = np.tile(grid.bound, sizes[2]), np.tile(limits.step, n - 1)
    low, high = (np.tile(one, n - 1) for one in (limits.low, limits.high))
    for b in range(2):
        cost = start.problems.cost[b] / start.scale[b]
        own = np.outer([0.0, *[1.0] * (n - 2), 0.5], cost[1:]) / (n - 1)
        price = np.array([0.5, *[1.0] * (n_points - 2), 0.5]) * cost[0] / (n_points - 1)
        p = start.schedule.copy()
        copy, dual = respond(p)[b], np.zeros(sum(sizes))
        for setting in iterate.settings:
            by_mass = np.tile(1.0 / (limits.mass * limits.unit**2), n - 1)
            on_omega, on_slack = setting[2] / (grid.bound**2 * POINTS), setting[3] / (limits.unit**2 * POINTS)
            parts = setting[0] * by_mass, setting[1] * by_mass, [on_omega] * sizes[2], [on_slack] * sizes[3]
            weight, now = np.concatenate(parts), respond(p)[b]
            wanted = setting[6] * now + (1.0 - setting[6]) * copy + dual / weight
            ends = np.split(wanted, np.cumsum(sizes)[:-1])
            tight = (1.0 - setting[7]) * bound
            shrunk = np.sign(ends[3]) * np.maximum(np.abs(ends[3]) - price / on_slack, 0.0)
            kept = np.clip(ends[0], low, high), np.clip(ends[1], -step, step), np.clip(ends[2], -tight, tight)
            copy = np.concatenate([*kept, shrunk])
            dual = weight * (wanted - copy)
            force = (columns[b].T @ (dual + weight * (now - copy))).reshape(n, n_gen) + own
            quadratic = setting[:2] / limits.unit**2
            model = np.array([*quadratic, on_omega * setting[4], on_slack * setting[5]])
            change = np.empty((n, n_gen))
            modal_change(maps[b], outputs[b], model, force @ into[b], change)
            p[b] += change @ into[b].T
        track(p, limits.low, limits.high, limits.step)
        np.testing.assert_allclose(found[b], p[b], atol=1e-4)


def test_answers_are_first_schedules_where_the_last_are_no_better(case: Case) -> None:
    """By the loss on the grid linearised along the first schedules; float32 leaves 1e-4 undecided."""
    policy = random_policy("ded-admm", case)
    grid = policy.grid
    start, linear = started(grid)
    last = CompiledIterations(grid, grid.bound, policy.weights["nodes"], 6, only_better=False)
    schedules = start.schedule, last(start, linear, start.schedule)
    losses = []
    for powers in schedules:
        _, omega, p_slack = grid.respond(powers, start, linear)
        given = zip(powers, omega, p_slack, start.problems.cost / start.scale[:, None], strict=True)
        losses.append([sum(schedule_loss(*one, grid.bound, float(grid.points[1]))) for one in given])
    gain = losses[0] - np.array(losses[1])
    assert (gain > 0.0).any()
    expected, clear = np.where(gain[:, None, None] >= 0.0, *schedules[::-1]), np.abs(gain) > 1e-4
    np.testing.assert_array_equal(policy.powers(start.problems)[clear], expected[clear])


def test_loss_is_the_scorers(ninebus: Case) -> None:
    """Cost within 0.05 %, penalty of the excess of |ω| within 2 %, of what the simulation says."""
    grid = modal_grid(ninebus, 60.0)
    instance = sample_instance(ninebus, POLICY_SEED, 7)
    start = grid.start(Problems.of(ninebus, [instance], grid.points))
    _, omega, p_slack = grid.respond(start.schedule, start, grid.along_first(start))
    cost, bound = start.problems.cost[0] / start.scale[0], 0.5 * grid.bound
    found = schedule_loss(start.schedule[0], omega[0], p_slack[0], cost, bound, float(grid.points[1]))
    schedule = Schedule(grid.knots, start.schedule[0])
    objective = score(ninebus, instance, schedule, "TO").objective
    assert found[0] * start.scale[0] * len(instance.grid) == pytest.approx(objective, rel=5e-4)
    excess = np.maximum(np.abs(simulate(ninebus, instance, schedule).omega) / bound - 1.0, 0.0)
    price = np.where(excess < STRAIGHT, excess**2 / 2, STRAIGHT * (excess - STRAIGHT / 2)) / DOUBLING
    assert found[1] == pytest.approx(PRICE * (excess + price).sum() * instance.dt_s, rel=0.02)


def test_training_starts_from_weights_of_another_grid(ninebus: Case, threebus: Case, tmp_path: Path) -> None:
    start, out = tmp_path / "start.safetensors", tmp_path / "p.safetensors"
    known = random_policy("ded-admm", threebus)
    known.save(start)
    found = read_start(start)
    assert all(np.array_equal(found[name], value) for name, value in known.weights.items())
    instances = short_instances(ninebus, 4)
    options = TrainingOptions(seconds=1e-3, epochs=1, start=start)
    trained = admm_training.train(ninebus, "TO", instances, out, options)
    assert trained.training["start"] == known.fingerprint
    assert trained.fingerprint != known.fingerprint
    other = tmp_path / "other.safetensors"
    write_policy(other, "ded-dpc", known.scope, known.weights, {})
    with pytest.raises(InputError, match="ded-admm"):
        read_start(other)


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


def test_weights_learned_for_few_iterations_do_not_serve_many(ninebus: Case) -> None:
    """A policy of less than ten iterations answers with its weights; those where training starts follow."""
    policy = random_policy("ded-admm", ninebus)
    for iterations, few in ((6, True), (12, False)):
        changed = dataclasses.replace(policy, training=policy.training | {"iterations": iterations})
        untrained = CompiledIterations(changed.grid, changed.grid.bound, np.zeros((4, 8)), 80)
        ratio = changed.further(80).settings / untrained.settings
        assert np.allclose(ratio[:, 4:], 1.0) == few
