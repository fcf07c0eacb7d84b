"""The follower and the clip of targets: values in NumPy and torch, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ded_bench.methods.dpc.differentiable_follower import Clip, Follow
from ded_bench.methods.ramp_follower import follow
from ded_bench.problem.compiled import compiled


def test_follower_in_torch_one_by_one_and_in_batches_agree() -> None:
    rng = np.random.default_rng(0)
    targets, start = rng.uniform(-1, 1, (7, 20, 3)), rng.uniform(-1, 1, (7, 3))
    step = np.array([0.1, 0.3, 0.5])
    p = follow(targets, start, step)
    for b in range(7):
        np.testing.assert_array_equal(follow(targets[b : b + 1], start[b : b + 1], step)[0], p[b])
    torch_p = Follow.apply(torch.as_tensor(targets), torch.as_tensor(start), torch.as_tensor(step))
    np.testing.assert_array_equal(torch_p.numpy(), p)
    np.testing.assert_allclose(np.abs(np.diff(p, axis=1)).max(axis=(0, 1)), step)
    slow = follow(targets, start, np.full(3, 10.0))
    np.testing.assert_array_equal(slow[:, 1:], targets)  # without a limit it is where it should be


def test_gradient_of_the_follower_is_the_recursions() -> None:
    rng = np.random.default_rng(1)
    targets = torch.tensor(rng.uniform(-1, 1, (5, 12, 2)), requires_grad=True)
    start = torch.tensor(rng.uniform(-1, 1, (5, 2)))
    weight = torch.tensor(rng.normal(size=(5, 13, 2)))
    step = torch.tensor([0.3, 0.5], dtype=torch.float64)
    (weight * Follow.apply(targets, start, step)).sum().backward()
    plain = targets.detach().clone().requires_grad_()
    p = [start]
    for target in plain.unbind(1):
        p.append(p[-1] + (target - p[-1]).clamp(-step, step))
    (weight * torch.stack(p, dim=1)).sum().backward()
    torch.testing.assert_close(targets.grad, plain.grad)
    assert 0 < int((targets.grad == 0).sum()) < targets.numel()


def test_clip_lets_descent_lead_back_inside() -> None:
    value = torch.tensor([-2.0, -2.0, 0.5, 3.0, 3.0], requires_grad=True)
    low, high = torch.tensor(0.0), torch.tensor(1.0)
    clipped = Clip.apply(value, low, high)
    (clipped * torch.tensor([1.0, -1.0, 2.0, 1.0, -1.0])).sum().backward()
    torch.testing.assert_close(clipped.detach(), torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0]))
    torch.testing.assert_close(value.grad, torch.tensor([0.0, -1.0, 2.0, 1.0, 0.0]))


def test_functions_are_compiled_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba refuses to cache if neither the package's folder nor the user's can be written."""
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])

    def double(values: np.ndarray) -> None:
        for i in range(len(values)):
            values[i] *= 2.0

    values = np.ones(3)
    compiled(double)(values)
    assert values.tolist() == [2.0, 2.0, 2.0]
