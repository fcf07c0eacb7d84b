"""The ramp follower in torch, for training."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def follow_within(targets: Tensor, p_initial: Tensor, low: Tensor, high: Tensor, step: Tensor) -> Tensor:
    """Clip targets to bounds and follow them within ramps; see `ramp_follower.track`.

    Args:
        targets: shape (batch, n_knots - 1, n_gen), pu.
        p_initial: P_0, shape (batch, n_gen), pu.
        low: lower bounds, (n_gen,), pu; likewise `high`.
        high: upper bounds.
        step: largest change between two knots, (n_gen,), pu.

    Returns:
        Shape (batch, n_knots, n_gen), pu.
    """
    inside = _Clip.apply(targets, low, high)  # type: ignore[no-untyped-call]
    powers: Tensor = _Follow.apply(inside, p_initial, step)  # type: ignore[no-untyped-call]
    return powers


class _Follow(torch.autograd.Function):
    """The follower. An adjoint by hand is ten times faster than recording 150 steps."""

    @staticmethod
    def forward(ctx: Any, targets: Tensor, p_initial: Tensor, step: Tensor) -> Tensor:
        p = [p_initial]
        for target in targets.unbind(1):
            p.append(torch.maximum(torch.minimum(p[-1] + step, target), p[-1] - step))
        out = torch.stack(p, dim=1)
        ctx.save_for_backward(out, targets, step)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = gradients
        p, targets, step = ctx.saved_tensors
        # where the rate limit binds, p depends on the knot before only, elsewhere on the target only
        limited = ((targets - p[:, :-1]).abs() > step).to(gradient.dtype)
        total = []
        carry = torch.zeros_like(gradient[:, 0])
        for own, binds in zip(reversed(gradient.unbind(1)[1:]), reversed(limited.unbind(1)), strict=True):
            total.append(own + carry)
            carry = total[-1] * binds
        return torch.stack(total[::-1], dim=1) * (1.0 - limited), None, None


class _Clip(torch.autograd.Function):
    """Clip to [low, high] with a gradient that can free what is stuck outside.

    The true derivative there is zero, so that a target beyond a bound would never be told to come
    back. Here it is told, if descent leads back inside.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(value, low, high)
        return torch.minimum(torch.maximum(value, low), high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = gradients
        value, low, high = ctx.saved_tensors
        outward = ((value > high) & (gradient < 0)) | ((value < low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None
