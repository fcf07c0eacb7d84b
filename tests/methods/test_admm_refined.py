"""More iterations after the shared policy's: what holds for any weights, and what they are worth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ded_bench.methods import ded_slp
from ded_bench.methods.admm import admm_refined as shared_refined
from ded_bench.methods.admm.admm_refined import Refiner, prepare
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.plants.score import score
from tests.methods.test_dpc_shared import in_operation, random_policy, short_instance


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


def test_unlearned_does_not_depend_on_weights(ninebus: Case, tmp_path: Path) -> None:
    answers: dict[str, list[np.ndarray]] = {name: [] for name in shared_refined.SETTINGS}
    for size in (0.1, 0.5):
        path = tmp_path / f"{size}.safetensors"
        random_policy(ninebus, size).save(path)
        for name, found in answers.items():
            schedule = prepare(ninebus, "TO", Settings(name, policy=path))(short_instance(ninebus)).schedule
            assert schedule is not None
            found.append(schedule.p)
    assert np.array_equal(*answers["unlearned"])
    assert not np.array_equal(*answers["default"])


@pytest.mark.parametrize("name", ["9bus", "two-area"])
def test_without_training_it_is_near_the_optimum(name: str, tmp_path: Path) -> None:
    """Eighty iterations from where training starts: within 0.5 % of `ded-slp`, and feasible."""
    case = Case.load(name)
    policy, path = random_policy(case, 0.0, case.sampling.horizon_s), tmp_path / "p.safetensors"
    policy.save(path)
    solve, optimal = prepare(case, "TO", Settings(policy=path)), ded_slp.prepare(case, "TO", Settings())
    for index in range(3):
        instance = sample_instance(case, VALIDATION_SEED, index)
        ours, best = (score(case, instance, method(instance).schedule, "TO") for method in (solve, optimal))
        assert ours.feasible
        assert ours.objective < 1.005 * best.objective


def test_weights_learned_for_few_iterations_do_not_serve_many(ninebus: Case) -> None:
    """A policy of less than ten iterations answers with its weights; those where training starts follow."""
    policy = random_policy(ninebus)
    for iterations, few in ((6, True), (12, False)):
        changed = dataclasses.replace(policy, training=policy.training | {"iterations": iterations})
        learned, start = (Refiner.of(changed, learned) for learned in (True, False))
        assert np.array_equal(learned.more._settings, start.more._settings) == few
        assert learned.policy.weights is policy.weights
