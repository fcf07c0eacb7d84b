"""The refined policy: what its steps converge to, and what holds after any number of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.surrogates.condensed import CondensedRollout
from ded_bench.surrogates.linear import linear_model
from ded_bench.methods.dpc import refinement
from ded_bench.methods.dpc.coarse_rollout import coarse_free_response, coarse_stride
from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.methods.dpc.policy import DispatchPolicy
from ded_bench.methods.dpc.policy_network import StagedNetwork
from ded_bench.methods.dpc.refined import SETTINGS, artifacts, prepare
from ded_bench.methods.dpc.refinement import Refiner
from ded_bench.methods.dpc.response import Response
from ded_bench.methods.policy_file import Scope, policy_file
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.solvers.status import Status
from ded_bench.plants.lossless.network import Network


def some_instances(case: Case, count: int) -> list[Instance]:
    return [sample_instance(case, POLICY_SEED, i) for i in range(count)]


def tightest(case: Case) -> str:
    return min(case.regimes, key=case.omega_bound)


def static_policy(case: Case, regime: str) -> DispatchPolicy:
    """The follower of the static dispatch: a network that corrects nothing."""
    horizon = case.sampling.horizon_s
    response = Response.make(case, case.knot_times(horizon))
    network = StagedNetwork(case, response, 1, 4, (1,)).eval()
    return DispatchPolicy.of(Scope(case, regime, horizon), network, {"seed": 0})


def optimum(case: Case, regime: str, instance: Instance) -> float:
    """The condensed problem's optimum, written as a linear program for another solver."""
    model, n_gen = linear_model(case), len(case.generators)
    knots = case.knot_times(instance.horizon_s)
    stride = coarse_stride(instance.dt_s, instance.steps, refinement.SPACING_S)
    inputs = Inputs.of(case, [instance])
    free = coarse_free_response(Network(case), model, inputs, instance.grid, stride)[0]
    condensed = CondensedRollout.make(case, model, instance.grid, knots, stride)
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
    case, inputs = refiner.case, Inputs.of(refiner.case, instances)
    n_gen = len(case.generators)
    free = coarse_free_response(refiner.network, refiner.model, inputs, refiner.grid, refiner.stride)
    knots = case.knot_times(refiner.grid[-1])
    condensed = CondensedRollout.make(case, refiner.model, refiner.grid, knots, refiner.stride)
    p_slack = free[:, n_gen] + condensed.apply(p_gen)[:, n_gen]
    generators = (np.einsum("bkg,k->bg", p_gen, condensed.hat_weights) * inputs.cost[:, 1:]).sum(axis=1)
    return generators + inputs.cost[:, 0] * (np.abs(p_slack) @ condensed.quadrature_weights)


def test_many_steps_reach_the_optimum_of_the_linear_program(case: Case) -> None:
    instances, regime = some_instances(case, 3), tightest(case)
    policy = static_policy(case, regime)
    inputs = Inputs.of(case, instances)
    refiner = Refiner.make(case, linear_model(case), regime, instances[0].grid, policy.knots)
    start = policy.powers(inputs)
    best = np.array([optimum(case, regime, i) for i in instances])
    gaps = [
        condensed_cost(refiner, instances, refiner(inputs, start, steps)) / best - 1.0
        for steps in (200, 3000)
    ]
    assert np.abs(gaps[1]).max() < 5e-4
    assert np.abs(gaps[1]).max() <= np.abs(gaps[0]).max()


@pytest.mark.parametrize("steps", [0, 1, 30])
def test_hard_limits_hold_after_any_number_of_steps(case: Case, steps: int) -> None:
    instances, regime = some_instances(case, 6), tightest(case)
    policy = static_policy(case, regime)
    inputs = Inputs.of(case, instances)
    refiner = Refiner.make(case, linear_model(case), regime, instances[0].grid, policy.knots)
    start = policy.powers(inputs)
    p_gen = refiner(inputs, start, steps)
    assert (np.abs(np.diff(p_gen, axis=1)) <= case.ramp * policy.knots[1] + 1e-12).all()
    assert np.maximum(p_gen - case.p_max, case.p_min - p_gen).max() <= 1e-12
    np.testing.assert_array_equal(p_gen[:, 0], inputs.p_initial)
    if not steps:
        np.testing.assert_allclose(p_gen, start, atol=1e-6)


def test_what_is_not_better_is_not_taken(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    instances, regime = some_instances(case, 4), tightest(case)
    policy = static_policy(case, regime)
    inputs = Inputs.of(case, instances)
    refiner = Refiner.make(case, linear_model(case), regime, instances[0].grid, policy.knots)
    good = refiner(inputs, policy.powers(inputs), 1000)
    monkeypatch.setattr(refinement, "DUAL_STEP", 50.0)  # diverges
    np.testing.assert_array_equal(refiner(inputs, good, 20), good)


def test_it_serves_as_a_method(threebus: Case, tmp_path: Path) -> None:
    regime, instance = tightest(threebus), some_instances(threebus, 1)[0]
    policy = static_policy(threebus, regime)
    policy.save(policy_file(tmp_path, "ded-dpc", regime, "linear"))
    settings = {name: Settings(name=name, model="linear", search=(tmp_path,)) for name in SETTINGS}
    answers = {name: prepare(threebus, regime, settings[name])(instance) for name in ("default", "steps25")}
    assert {a.status for a in answers.values()} == {Status.POLICY}
    assert answers["default"].iterations == refinement.STEPS
    assert answers["steps25"].iterations == 25
    assert answers["default"].solve_s > 0
    assert not np.array_equal(answers["default"].schedule.p, answers["steps25"].schedule.p)
    before = artifacts(threebus, regime, settings["default"])
    policy.weights["stages.0.last.bias"][:] = 1.0
    policy.save(policy_file(tmp_path, "ded-dpc", regime, "linear"))
    assert artifacts(threebus, regime, settings["default"]) != before
