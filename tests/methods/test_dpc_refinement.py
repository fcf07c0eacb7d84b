"""Refinement of our policy's answers: what its steps converge to, and what is taken of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.files.errors import InputError
from ded_bench.methods.dpc import refinement
from ded_bench.methods.dpc.channels import Channels, Response
from ded_bench.methods.dpc.dpc_policy import artifacts, prepare
from ded_bench.methods.dpc.refinement import Refiner, coarse_free_response
from ded_bench.methods.solution import Settings
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.training_record import policy_file
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import largest_divisor
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.surrogates.koopman import CondensedRollout
from ded_bench.surrogates.linear import linear_model
from tests.methods.policies import random_policy, tightest


def static_schedules(case: Case, count: int) -> tuple[list[Instance], StackedInstances, Array]:
    """Instances, the same stacked, and the schedules that follow their static dispatch."""
    instances = [sample_instance(case, POLICY_SEED, i) for i in range(count)]
    inputs = StackedInstances.of(case, instances)
    response = Response.make(case, case.knot_times(case.sampling.horizon_s))
    return instances, inputs, Channels.of(case, inputs, response).start


def refiner_of(case: Case, instance: Instance) -> Refiner:
    knots = case.knot_times(instance.horizon_s)
    return Refiner(case, linear_model(case), tightest(case), instance.grid, knots)


def optimum(case: Case, regime: str, instance: Instance) -> float:
    """The condensed problem's optimum, written as a linear program for another solver."""
    model, n_gen = linear_model(case), len(case.generators)
    knots = case.knot_times(instance.horizon_s)
    stride = largest_divisor(instance.steps, round(refinement.SPACING_S / instance.dt_s))
    inputs = StackedInstances.of(case, [instance])
    free = coarse_free_response(model, inputs, instance.grid, stride)[0]
    condensed = CondensedRollout.make(model, instance.grid, knots, stride)
    n, n_knots = len(condensed.points), len(knots)
    slack, omega = condensed.gamma[n_gen], condensed.gamma[:n_gen].reshape(n * n_gen, -1)
    bound = case.omega_bound(regime) * (1.0 - refinement.MARGIN)
    unit = np.eye(n_knots * n_gen)
    change = unit[n_gen:] - unit[:-n_gen]
    cost_gen = np.outer(condensed.hat_weights, inputs.cost[0, 1:]).ravel()
    cost = np.concatenate([cost_gen, inputs.cost[0, 0] * condensed.quadrature_weights])
    none = np.zeros((len(omega), n))
    above = np.vstack(
        [
            np.hstack([slack, -np.eye(n)]),
            np.hstack([-slack, -np.eye(n)]),
            np.hstack([omega, none]),
            np.hstack([-omega, none]),
            np.hstack([change, np.zeros((len(change), n))]),
            np.hstack([-change, np.zeros((len(change), n))]),
        ]
    )
    flat = free[:n_gen].ravel().astype(float)
    step = np.tile(case.ramp * knots[1], 2 * (n_knots - 1))
    limits = np.concatenate([-free[n_gen], free[n_gen], bound - flat, bound + flat, step])
    bounds = [*zip(np.tile(case.p_min, n_knots), np.tile(case.p_max, n_knots), strict=True)]
    bounds[:n_gen] = [(p, p) for p in inputs.p_initial[0]]
    result = linprog(cost, above, limits, bounds=bounds + [(0, None)] * n)
    assert result.status == 0
    return float(result.fun)


def condensed_cost(refiner: Refiner, instances: list[Instance], p_gen: np.ndarray) -> np.ndarray:
    """Cost of schedules on the coarse points, by the model."""
    case, inputs = refiner.case, StackedInstances.of(refiner.case, instances)
    n_gen = len(case.generators)
    free = coarse_free_response(refiner.model, inputs, refiner.grid, refiner.stride)
    knots = case.knot_times(refiner.grid[-1])
    condensed = CondensedRollout.make(refiner.model, refiner.grid, knots, refiner.stride)
    p_slack = free[:, n_gen] + p_gen.reshape(len(p_gen), -1) @ condensed.gamma[n_gen].T
    generators = (np.einsum("bkg,k->bg", p_gen, condensed.hat_weights) * inputs.cost[:, 1:]).sum(axis=1)
    return generators + inputs.cost[:, 0] * (np.abs(p_slack) @ condensed.quadrature_weights)


def test_many_steps_reach_the_optimum_of_the_linear_program(case: Case) -> None:
    instances, inputs, start = static_schedules(case, 3)
    refiner = refiner_of(case, instances[0])
    best = np.array([optimum(case, tightest(case), i) for i in instances])
    gaps = [
        condensed_cost(refiner, instances, refiner(inputs, start, steps)) / best - 1.0
        for steps in (200, 3000)
    ]
    assert np.abs(gaps[1]).max() < 5e-4
    assert np.abs(gaps[1]).max() <= np.abs(gaps[0]).max()


def test_what_is_not_better_is_not_taken(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    instances, inputs, start = static_schedules(case, 4)
    refiner = refiner_of(case, instances[0])
    np.testing.assert_allclose(refiner(inputs, start, 0), start, atol=1e-6)
    good = refiner(inputs, start, 1000)
    monkeypatch.setattr(refinement, "DUAL_STEP", 50.0)  # diverges
    np.testing.assert_array_equal(refiner(inputs, good, 20), good)


def test_it_is_an_option_that_needs_a_model(threebus: Case, tmp_path: Path) -> None:
    policy = random_policy("ded-dpc", threebus, horizon=threebus.sampling.horizon_s)
    regime, instance = policy.scope.regime, sample_instance(threebus, POLICY_SEED, 1)
    policy.save(policy_file(tmp_path, "ded-dpc", regime, "linear"))
    settings = [Settings(o, "linear", search=(tmp_path,)) for o in ("default", "refine=100", "refine=300")]
    answers = [prepare(threebus, regime, chosen)(instance) for chosen in settings]
    assert [answer.iterations for answer in answers] == [None, 100, 300]
    assert len({answer.schedule.p.tobytes() for answer in answers}) == 3
    needed = [[one.kind for one in artifacts(threebus, regime, chosen)] for chosen in settings]
    assert needed == [["policy"], ["policy", "model"], ["policy", "model"]]
    with pytest.raises(InputError, match="but the model linear has steps of"):
        prepare(threebus, regime, settings[1])(instance.model_copy(update={"dt_s": 2.0 * instance.dt_s}))
