"""Training of our policy: it learns, repeats, goes on after an interruption, and is what its settings say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from ded_bench.surrogates.linear import linear_model
from ded_bench.methods.dpc import training
from ded_bench.methods.dpc.export import network_of
from ded_bench.methods.dpc.inputs import Inputs, sequence_groups
from ded_bench.methods.dpc.policy import SETTINGS, DispatchPolicy
from ded_bench.methods.dpc.policy_network import StagedNetwork
from ded_bench.methods.dpc.training import train
from ded_bench.methods.ramp_follower import follow
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.problem.case import Case
from tests.methods.test_dpc import some_instances, tensors


def short_training(case: Case, out: Path, **options: object) -> DispatchPolicy:
    """A few epochs on few instances."""
    given = {"seed": 3, "epochs": 6, "fresh": 300} | options
    names = {field.name for field in dataclasses.fields(TrainingOptions)} & given.keys()
    common = TrainingOptions(**{name: given.pop(name) for name in names})
    regime = next(iter(case.regimes))
    return train(case, regime, some_instances(case, 10), linear_model(case), out, common, **given)


def history_of(case: Case, out: Path, **options: object) -> pd.Series:
    """Held-out losses of a training of three epochs."""
    short_training(case, out, epochs=3, **options)
    return pd.read_csv(out.with_suffix(".history.csv"))["held out"]


def test_training_beats_the_static_dispatch_and_repeats(threebus: Case, tmp_path: Path) -> None:
    one = short_training(threebus, tmp_path / "a.safetensors")
    two = short_training(threebus, tmp_path / "b.safetensors")
    assert one.fingerprint == two.fingerprint
    history = pd.read_csv(tmp_path / "a.history.csv")
    assert history["epoch"].tolist() == [1, 2, 3, 4, 5, 6]
    assert history["held out"].iloc[-1] < history["held out"].iloc[0]
    assert one.training["held_out_loss"] == pytest.approx(history["held out"].min())
    assert one.training["instances"] == 300
    assert one.training["fresh"]
    other = short_training(threebus, tmp_path / "c.safetensors", seed=4)
    assert other.fingerprint != one.fingerprint
    given = short_training(threebus, tmp_path / "d.safetensors", fresh=0)
    assert (given.training["instances"], given.training["held_out"]) == (8, 2)


def test_an_interrupted_training_goes_on_to_the_same_weights(
    threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = short_training(threebus, tmp_path / "a.safetensors")
    save, saved = training._Run._save, []

    def save_twice(run: training._Run) -> None:
        save(run)
        saved.append(run.epoch)
        if len(saved) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training._Run, "_save", save_twice)
        with pytest.raises(KeyboardInterrupt):
            short_training(threebus, tmp_path / "b.safetensors")
    assert saved == [1, 2]
    resumed = short_training(threebus, tmp_path / "b.safetensors", resume=True)
    assert resumed.fingerprint == whole.fingerprint
    assert resumed.training["steps"] == whole.training["steps"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_training_on_a_gpu_gives_the_same_losses(threebus: Case, tmp_path: Path) -> None:
    histories = [
        history_of(threebus, tmp_path / f"{device}.safetensors", device=device) for device in ("cpu", "cuda")
    ]
    np.testing.assert_allclose(histories[0], histories[1], rtol=1e-4)


def test_rounding_otherwise_leaves_the_losses_the_same(
    threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What another device's order of summation does, some float32 epsilons, must not grow in training."""
    histories = [history_of(threebus, tmp_path / "a.safetensors")]
    powers, noise = training.Loss.powers, torch.Generator().manual_seed(1)

    def rounded(self: training.Loss, network: StagedNetwork, pool: training.Pool) -> torch.Tensor:
        exact = powers(self, network, pool)
        return exact * (1.0 + 1e-6 * torch.randn(exact.shape, generator=noise))

    monkeypatch.setattr(training.Loss, "powers", rounded)
    histories.append(history_of(threebus, tmp_path / "b.safetensors"))
    assert not histories[0].equals(histories[1])
    np.testing.assert_allclose(histories[0], histories[1], rtol=1e-4)


def test_training_would_not_round_on_a_gpu(
    threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TensorFloat-32, cuDNN's default, keeps ten bits: losses would differ by 1e-3 from the CPU's."""
    rounds = []
    validate = training._Run._validate

    def look(run: training._Run, check: training.Pool) -> dict[str, float]:
        rounds.append(torch.backends.cudnn.allow_tf32)
        return validate(run, check)

    monkeypatch.setattr(training._Run, "_validate", look)
    short_training(threebus, tmp_path / "p.safetensors", epochs=1)
    assert rounds
    assert not any(rounds)
    assert torch.get_float32_matmul_precision() == "highest"


def test_variants_of_the_study_are_what_they_say(threebus: Case, tmp_path: Path) -> None:
    """What was trained is what the file answers with, without the prior and blind to the dispatch."""
    path = tmp_path / "v.safetensors"
    options = {"stages": 1, "width": 8, "dilations": (1, 2), "batch": 16, "rate": "constant"}
    options |= {"prior": False, "blind": ("dispatch", "response")}
    policy = short_training(threebus, path, epochs=2, **options)
    assert policy.training["variant"] == options
    loaded = DispatchPolicy.load(path, threebus, policy.scope.regime)
    inputs = Inputs.of(threebus, some_instances(threebus, 4))
    np.testing.assert_array_equal(loaded.powers(inputs), policy.powers(inputs))
    channels = policy.channels(inputs)
    middle = np.broadcast_to(0.5 * (threebus.p_min + threebus.p_max), channels.start[:, 1:].shape)
    np.testing.assert_array_equal(
        channels.start, follow(middle, inputs.p_initial, threebus.ramp * policy.knots[1])
    )
    start, free, sequence, constants = tensors(channels)
    other = sequence.clone()
    other[..., sequence_groups(threebus)["dispatch"]] += 0.3
    network = network_of(policy)
    with torch.no_grad():
        seen = network(start, free, sequence, constants)
        unseen = network(start, free + 0.3, other, constants)
    torch.testing.assert_close(seen, unseen)
    np.testing.assert_allclose(policy.powers(inputs), seen.numpy(), atol=1e-5)
    with pytest.raises(TypeError, match="colour"):
        short_training(threebus, path, colour="red")


def test_every_setting_is_one_that_train_knows() -> None:
    for slug, options in SETTINGS.items():
        variant = {k: v for k, v in options.items() if k not in ("epochs", "fresh")}
        changed = training.Variant(**variant)
        assert (changed == training.Variant()) == (not variant), slug


def test_a_time_limit_ends_the_training(threebus: Case, tmp_path: Path) -> None:
    policy = short_training(threebus, tmp_path / "a.safetensors", epochs=10_000, seconds=0.5)
    assert 0.5 <= policy.training["seconds"] < 5.0
    assert policy.training["epochs"] < 10_000
