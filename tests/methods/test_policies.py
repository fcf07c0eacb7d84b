"""What holds for every trained policy: limits, files, refusals, answers as a method, training."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.admm import admm_training
from ded_bench.methods.dpc import training as dpc_training
from ded_bench.methods.dpc_paper import paper_training
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings
from ded_bench.methods.trained_policy import TrainedPolicy
from ded_bench.methods.training_record import HISTORY, TrainingOptions, checkpoint_file, policy_file
from ded_bench.methods.training_run import TrainingRun
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.solvers.status import Status
from ded_bench.surrogates.linear import linear_model
from tests.methods.policies import in_operation, random_policy, short_instances

TRAINERS = {"ded-dpc": dpc_training, "ded-dpc-paper": paper_training, "ded-admm": admm_training}
CONSTRUCTED = ("ded-dpc", "ded-dpc refine=30", "ded-admm", "ded-admm iterations=5")


@pytest.mark.parametrize("size", [0.0, 0.3, 30.0])
@pytest.mark.parametrize("name", CONSTRUCTED)
def test_limits_hold_for_any_weights(case: Case, name: str, size: float, tmp_path: Path) -> None:
    """Ramps, bounds and P_0 to round-off, for ramps and in operation, refined or not."""
    method, _, options = name.partition(" ")
    policy, path = random_policy(method, case, size), tmp_path / "p.safetensors"
    policy.save(path)
    settings = Settings(options, model="linear", policy=path)
    solve = METHODS[method].prepare(case, policy.scope.regime, settings)
    for instance in (*short_instances(case, 3, 4), in_operation(case, 5)):
        schedule = solve(instance).schedule
        assert schedule is not None
        judged = score(case, instance, schedule, policy.scope.regime)
        assert judged.ramp_violation < 1e-12
        assert judged.bound_violation < 1e-12
        np.testing.assert_array_equal(schedule.p[0], instance.p_initial(case))


@pytest.mark.parametrize("method", TRAINERS)
def test_files_round_trip_and_answer_as_a_method(threebus: Case, method: str, tmp_path: Path) -> None:
    policy = random_policy(method, threebus)
    path = policy_file(tmp_path, method, policy.scope.regime)
    policy.save(path)
    settings = Settings(search=(tmp_path,))
    loaded = type(policy).find(threebus, policy.scope.regime, settings)
    assert loaded.fingerprint == policy.fingerprint
    instances = short_instances(threebus, 3)
    for one, other in zip(loaded(instances), policy(instances), strict=True):
        np.testing.assert_array_equal(one.p, other.p)
    for instance, together in zip(instances, policy(instances), strict=True):
        np.testing.assert_allclose(policy(instance)[0].p, together.p, atol=1e-5)  # float32
    assert policy([]) == []
    solution = METHODS[method].prepare(threebus, policy.scope.regime, settings)(instances[0])
    assert solution.status == Status.POLICY
    assert solution.solve_s > 0
    assert solution.iterations is None
    np.testing.assert_array_equal(solution.schedule.p, policy(instances[0])[0].p)
    (artifact,) = METHODS[method].artifacts(threebus, policy.scope.regime, settings)
    assert (artifact.name, artifact.fingerprint, artifact.path) == (method, policy.fingerprint, path)


@pytest.mark.parametrize("method", TRAINERS)
def test_a_policy_refuses_what_it_was_not_trained_for(
    threebus: Case, ninebus: Case, method: str, tmp_path: Path, alter
) -> None:
    policy, path = random_policy(method, threebus), tmp_path / "p.safetensors"
    policy.save(path)
    regime, load = policy.scope.regime, type(policy).load
    with pytest.raises(InputError, match="regime"):
        load(path, threebus, next(r for r in threebus.regimes if r != regime))
    with pytest.raises(InputError, match="case"):
        load(path, ninebus, regime)
    with pytest.raises(InputError, match="case_fingerprint"):
        load(path, alter(threebus, ramp_pu_per_s=0.01), regime)
    with pytest.raises(InputError, match="horizon"):
        policy(short_instances(threebus, 1, horizon=2.0))
    with pytest.raises(InputError, match="case"):
        policy(short_instances(ninebus, 1))
    told = "" if method == "ded-admm" else ".* --model linear"  # its weights know no surrogate
    with pytest.raises(InputError, match=f"train-dpc --method {method}{told}"):
        METHODS[method].prepare(threebus, regime, Settings(model="linear", search=(tmp_path,)))
    name, *_ = policy.weights
    dataclasses.replace(policy, weights=policy.weights | {name: np.zeros((2, 7), np.float32)}).save(path)
    with pytest.raises(InputError, match=f"{name}.*wrong shape"):
        load(path, threebus, regime)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"p\.safetensors"):
        load(path, threebus, regime)


@pytest.mark.parametrize(
    ("method", "name", "value", "problem"),
    [("ded-admm", "iterations", "many", "iterations"), ("ded-admm", "margin", "some", "margin")],
)
def test_facts_that_do_not_fit_are_refused(
    threebus: Case, tmp_path: Path, method: str, name: str, value: object, problem: str
) -> None:
    policy, path = random_policy(method, threebus), tmp_path / "p.safetensors"
    dataclasses.replace(policy, training=policy.training | {name: value}).save(path)
    with pytest.raises(InputError, match=problem):
        type(policy).load(path, threebus, policy.scope.regime)


def test_a_fingerprint_follows_all_that_decides_on_answers(threebus: Case, tmp_path: Path) -> None:
    """Those of files of the first kind, which the rows of reference runs carry, follow weights alone."""
    policy, path = random_policy("ded-admm", threebus), tmp_path / "p.safetensors"
    facts = [
        policy.training | change for change in ({}, {"margin": 0.25}, {"iterations": 99}, {"seconds": 1.0})
    ]
    found = [dataclasses.replace(policy, training=training).fingerprint for training in facts]
    assert len(set(found[:3])) == 3
    assert found[3] == found[0]
    scope = dataclasses.replace(policy.scope, horizon_s=2.0 * policy.scope.horizon_s)
    assert dataclasses.replace(policy, scope=scope).fingerprint not in found
    first = dataclasses.replace(policy, schema="ded-bench/policy/1")
    first.save(path)
    other = dataclasses.replace(type(policy).load(path, threebus, policy.scope.regime), training=facts[1])
    assert other.fingerprint == first.fingerprint != found[0]
    dataclasses.replace(policy, schema="ded-bench/policy/3").save(path)
    with pytest.raises(InputError, match="schema: is 'ded-bench/policy/3'"):
        type(policy).load(path, threebus, policy.scope.regime)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Little is drawn, and epochs are short."""
    monkeypatch.setattr(dpc_training, "FRESH", 300)
    monkeypatch.setattr(admm_training, "STEPS", 4)
    monkeypatch.setattr(admm_training, "ROWS", 400)
    monkeypatch.setattr(admm_training, "TIGHT", (6, 0))


def trained(module: ModuleType, case: Case, out: Path, **options: object) -> TrainedPolicy:
    """A short training on ten instances."""
    model = out.with_name("model.safetensors")
    linear_model(case).save(model)
    surrogate = "" if module is admm_training else str(model)
    given = TrainingOptions(**({"seed": 3, "epochs": 4, "model": surrogate} | options))
    return module.train(case, list(case.regimes)[-1], short_instances(case, 10, horizon=4.0), out, given)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", TRAINERS)
def test_training_keeps_the_best_repeats_and_goes_on(
    threebus: Case, tmp_path: Path, method: str, alter, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = TRAINERS[method]
    whole = trained(module, threebus, tmp_path / "a.safetensors", version="1.2.3")
    history = pd.read_csv(tmp_path / "a.history.csv")
    assert tuple(history)[:4] == HISTORY
    assert history["epoch"].tolist() == [1, 2, 3, 4]
    decisive = "training" if history["held out"].isna().all() else "held out"
    kept = history[decisive].iloc[-1] if decisive == "training" else history[decisive].min()
    assert whole.training[f"{decisive.replace(' ', '_')}_loss"] == pytest.approx(kept)
    assert method == "ded-admm" or history[decisive].iloc[-1] < history[decisive].iloc[0]  # of few steps
    assert (whole.training["version"], whole.training["seed"]) == ("1.2.3", 3)
    loaded = type(whole).load(tmp_path / "a.safetensors", threebus, whole.scope.regime)
    assert loaded.fingerprint == whole.fingerprint
    save = TrainingRun.save

    def interrupted(run: TrainingRun) -> None:
        save(run)
        if run.epoch == 2:
            raise KeyboardInterrupt

    out = tmp_path / "b.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            trained(module, threebus, out)
    resumed = trained(module, threebus, out, resume=True)
    assert resumed.fingerprint == whole.fingerprint
    assert resumed.training["steps"] == whole.training["steps"]
    assert trained(module, threebus, tmp_path / "c.safetensors", seed=4).fingerprint != whole.fingerprint
    with pytest.raises(InputError, match="no checkpoint of this training"):
        trained(module, threebus, out, resume=True, seed=4)
    with pytest.raises(InputError, match="no checkpoint of this training"):
        trained(module, alter(threebus, ramp_pu_per_s=0.01), out, resume=True)
    checkpoint_file(out).write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="no checkpoint"):
        trained(module, threebus, out, resume=True)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", TRAINERS)
def test_a_time_limit_ends_the_training(threebus: Case, tmp_path: Path, method: str) -> None:
    policy = trained(TRAINERS[method], threebus, tmp_path / "a.safetensors", epochs=100_000, seconds=0.3)
    assert 0.3 <= policy.training["seconds"] < 60.0  # a first step may take seconds
    assert 1 <= policy.training["epochs"] < 100_000


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", TRAINERS)
def test_what_is_finished_stays_finished(threebus: Case, tmp_path: Path, method: str) -> None:
    """Resumed, it takes no step; with more time the learning rate goes on from where it was."""
    limited = {"epochs": 100_000, "seconds": 0.3}
    first = trained(TRAINERS[method], threebus, tmp_path / "a.safetensors", **limited)
    again = trained(TRAINERS[method], threebus, tmp_path / "a.safetensors", resume=True, **limited)
    assert (again.fingerprint, again.training["steps"]) == (first.fingerprint, first.training["steps"])


@pytest.mark.parametrize("seconds", [50, 500])
def test_a_resumed_training_may_have_other_instances(
    threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: int
) -> None:
    """Of `ded-dpc`, whose time decides how many are drawn: all of them are trained on."""
    monkeypatch.setattr(dpc_training, "FRESH_PER_SECOND", 1)
    out, seen = tmp_path / "a.safetensors", set[int]()
    trained(dpc_training, threebus, out, seconds=150.0, epochs=1)
    monkeypatch.setattr(TrainingRun, "_take_step", lambda run, rows, progress: seen.update(rows.tolist()))
    policy = trained(dpc_training, threebus, out, seconds=float(seconds), resume=True)
    assert policy.training["instances"] == seconds
    assert seen == set(range(seconds))
