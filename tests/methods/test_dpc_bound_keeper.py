"""The last step of our policy: what it predicts, leaves alone and mends, and what holds whatever it does."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.methods.dpc.channels import Channels
from ded_bench.methods.dpc.dpc_policy import DispatchPolicy
from ded_bench.methods.dpc.refinement import PARTS, BoundKeeper, predict
from ded_bench.methods.knots import track
from ded_bench.methods.solution import Settings
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import search_folders
from ded_bench.surrogates.linear import by_angles, linear_model

#: Bounds so tight that every schedule exceeds them.
TIGHT = 1e-3


def drawn(case: Case, count: int) -> StackedInstances:
    """Instances off their equilibrium: some angles too, which Table III has not."""
    inputs = StackedInstances.of(case, [sample_instance(case, POLICY_SEED, i) for i in range(count)])
    inputs.delta[::2] = np.random.default_rng(1).normal(0.0, 0.01, inputs.delta[::2].shape)
    return inputs


def random_powers(case: Case, inputs: StackedInstances, size: float) -> Array:
    """Schedules that go somewhere at random, within every limit, (batch, n_knots, n_gen), pu."""
    knots, rng = case.knot_times(case.sampling.horizon_s), np.random.default_rng(0)
    middle, half = 0.5 * (case.p_min + case.p_max), 0.5 * (case.p_max - case.p_min)
    targets = middle + size * half * rng.uniform(-1.0, 1.0, (len(inputs), len(knots) - 1, len(half)))
    powers = np.concatenate([inputs.p_initial[:, None], targets], axis=1)
    track(powers, case.p_min, case.p_max, case.ramp * knots[1])
    return powers


def keeper_of(case: Case, scale: float = 1.0) -> BoundKeeper:
    """On bounds scaled by a factor."""
    made = BoundKeeper(case, next(iter(case.regimes)), case.knot_times(case.sampling.horizon_s))
    made.limit *= scale
    return made


def omega_of(keeper: BoundKeeper, inputs: StackedInstances, p_gen: Array) -> Array:
    """What the keeper predicts, (batch, n_gen, n_points), rad/s."""
    omega = np.full((len(inputs), p_gen.shape[2], len(keeper.limit)), np.nan)
    by_generator = np.ascontiguousarray(p_gen.swapaxes(1, 2))
    state = np.concatenate([inputs.delta, inputs.omega], axis=1)
    exceeds = predict(inputs.load, state, by_generator, keeper.model, keeper.limit, keeper.spacing_s, omega)
    assert exceeds == (np.abs(omega) > keeper.limit).any()
    return omega


def excess(keeper: BoundKeeper, omega: Array) -> Array:
    return (np.maximum(np.abs(omega) - keeper.limit, 0.0) ** 2).sum(axis=(1, 2))


def test_the_prediction_is_the_linear_models(case: Case) -> None:
    keeper, inputs = keeper_of(case), drawn(case, 5)
    p_gen = random_powers(case, inputs, 0.5)
    points = np.linspace(0.0, case.sampling.horizon_s, PARTS * (case.n_knots - 1) + 1)
    knots, n_gen = case.knot_times(case.sampling.horizon_s), len(case.generators)
    model = linear_model(case, float(points[1]))
    for b, omega in enumerate(omega_of(keeper, inputs, p_gen)):
        powers = np.stack([np.interp(points, knots, column) for column in p_gen[b].T], axis=1)
        both = np.hstack([powers, inputs[b : b + 1].p_load(points)[0]])
        psi = both[0] @ model.b.T + by_angles(case) @ inputs.delta[b]
        psi[:n_gen] += inputs.omega[b]
        np.testing.assert_allclose(omega.T, model.rollout(psi, both)[:, :n_gen], atol=1e-12)
    change = random_powers(case, inputs, 0.3) - p_gen
    moved = omega_of(keeper, inputs, p_gen + change) - omega_of(keeper, inputs, p_gen)
    np.testing.assert_allclose(np.tensordot(change, keeper.of_power, ([1, 2], [2, 3])), moved, atol=1e-12)


@pytest.mark.parametrize("scale", [TIGHT, 0.3, 1.0])
@pytest.mark.parametrize("size", [0.1, 1.0])
def test_excess_falls_and_limits_hold(case: Case, scale: float, size: float) -> None:
    inputs = drawn(case, 6)
    p_gen = random_powers(case, inputs, size)
    keeper = keeper_of(case, scale)
    kept = keeper(inputs, p_gen)
    before, after = (excess(keeper, omega_of(keeper, inputs, p)) for p in (p_gen, kept))
    assert (after <= before).all()
    assert ((after < before) == (kept != p_gen).any(axis=(1, 2))).all()
    assert scale != TIGHT or (after < before).all()
    step = case.ramp * case.knot_times(case.sampling.horizon_s)[1]
    assert (np.abs(np.diff(kept, axis=1)) <= step + 1e-12).all()
    assert np.maximum(kept - case.p_max, case.p_min - kept).max() <= 1e-12
    np.testing.assert_array_equal(kept[:, 0], inputs.p_initial)
    np.testing.assert_array_equal(keeper(inputs, p_gen), kept)


@pytest.mark.parametrize("index", [10_003, 10_302])
def test_what_the_committed_policy_exceeds_is_mended(ninebus: Case, index: int) -> None:
    """Two validation instances on which the network alone exceeds the bound, simulated on the true system."""
    policy = DispatchPolicy.find(ninebus, "TO", Settings(search=search_folders(ninebus)))
    instance = sample_instance(ninebus, VALIDATION_SEED, index)
    inputs = StackedInstances.of(ninebus, [instance])
    network = policy._compiled(Channels.of(ninebus, inputs, policy.response))
    alone, kept = (
        score(ninebus, instance, Schedule(policy.knots, p[0]), "TO") for p in (network, policy.powers(inputs))
    )
    assert alone.freq_violation_hz > 5e-5
    assert kept.freq_violation_hz == 0.0
    assert kept.objective == pytest.approx(alone.objective, rel=2e-3)
    np.testing.assert_array_equal(policy(instance)[0].p, policy.powers(inputs)[0])
