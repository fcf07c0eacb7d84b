"""The follower and the clip of targets: values in NumPy and torch, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ded_bench.methods.knots import track
from ded_bench.methods.training_run import follow_within
from ded_bench.problem.compiled import compiled

LOW, HIGH, STEP = np.array([-0.5, -0.6, -9.0]), np.array([0.4, 0.8, 9.0]), np.array([0.1, 0.3, 0.5])


def test_follower_compiled_in_torch_and_one_by_one_agree() -> None:
    rng = np.random.default_rng(0)
    targets, start = rng.uniform(-1, 1, (7, 20, 3)), np.full((7, 3), 0.1)
    p = np.concatenate([start[:, None], targets], axis=1)
    track(p, LOW, HIGH, STEP)
    for b in range(7):
        alone = np.concatenate([start[:1], targets[b]])[None]
        track(alone, LOW, HIGH, STEP)
        np.testing.assert_array_equal(alone[0], p[b])
    found = follow_within(*map(torch.as_tensor, (targets, start, LOW, HIGH, STEP)))
    np.testing.assert_array_equal(found.numpy(), p)
    np.testing.assert_allclose(np.abs(np.diff(p, axis=1)).max(axis=(0, 1)), STEP)
    slow, endless = np.concatenate([start[:, None], targets], axis=1), np.full(3, np.inf)
    track(slow, -endless, endless, np.full(3, 10.0))
    np.testing.assert_array_equal(slow[:, 1:], targets)  # without a limit it is where it should be


def test_gradient_of_the_follower_is_the_recursions() -> None:
    """Where no target lies beyond a bound."""
    rng = np.random.default_rng(1)
    targets = torch.tensor(rng.uniform(-1, 1, (5, 12, 2)), requires_grad=True)
    start = torch.tensor(rng.uniform(-1, 1, (5, 2)))
    weight = torch.tensor(rng.normal(size=(5, 13, 2)))
    low, high, step = torch.tensor([-2.0, -2.0]), torch.tensor([2.0, 2.0]), torch.tensor([0.3, 0.5])
    (weight * follow_within(targets, start, low.double(), high.double(), step.double())).sum().backward()
    plain = targets.detach().clone().requires_grad_()
    p = [start]
    for target in plain.unbind(1):
        p.append(p[-1] + (target - p[-1]).clamp(-step, step))
    (weight * torch.stack(p, dim=1)).sum().backward()
    torch.testing.assert_close(targets.grad, plain.grad)
    assert 0 < int((targets.grad == 0).sum()) < targets.numel()


def test_a_target_beyond_a_bound_can_come_back() -> None:
    low, high, far = torch.zeros(1), torch.ones(1), torch.full((1,), 9.0)
    for target, sign, expected in ((2.0, 1.0, 1.0), (2.0, -1.0, 0.0), (-2.0, 1.0, 0.0), (-2.0, -1.0, -1.0)):
        targets = torch.full((1, 1, 1), target, requires_grad=True)
        (sign * follow_within(targets, torch.zeros(1, 1), low, high, far)).sum().backward()
        assert float(targets.grad) == expected


def test_functions_are_compiled_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba refuses to cache if neither the package's folder nor the user's can be written."""
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])

    def double(values: np.ndarray) -> None:
        for i in range(len(values)):
            values[i] *= 2.0

    values = np.ones(3)
    compiled(double)(values)
    assert values.tolist() == [2.0, 2.0, 2.0]
