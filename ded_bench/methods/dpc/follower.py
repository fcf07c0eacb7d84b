"""Schedules that meet bounds, ramps and P_0 whatever is asked: a rate-limited follower of targets.

    p_0 = P_0,   p_{j+1} = p_j + clip(target_{j+1} - p_j, -step, step)

with targets clipped to the generator bounds and `step` the ramp limit times the spacing of the
knots. By induction p stays within bounds if P_0 is. Between knots a schedule is linear, so no two
neighbouring grid points differ by more than the limit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ded_bench.methods.dpc.kernels import track
from ded_bench.problem.case import Array


def follow(targets: Array, p_initial: Array, step: Array) -> Array:
    """Follow targets in float64.

    Args:
        targets: within bounds, shape (batch, n_knots - 1, n_gen), pu.
        p_initial: P_0, shape (batch, n_gen), pu.
        step: largest change between two knots, (n_gen,), pu.

    Returns:
        Shape (batch, n_knots, n_gen), pu.
    """
    p_gen = np.concatenate([p_initial[:, None], targets], axis=1)
    for powers in p_gen:
        track(powers.T, step, powers.T)
    return p_gen


class Follow(torch.autograd.Function):
    """`follow` for training; its adjoint by hand is ten times faster than recording 150 operations."""

    @staticmethod
    def forward(ctx: Any, targets: Tensor, p_initial: Tensor, step: Tensor) -> Tensor:
        """See `follow`."""
        p = [p_initial]
        for target in targets.unbind(1):
            p.append(torch.maximum(torch.minimum(p[-1] + step, target), p[-1] - step))
        out = torch.stack(p, dim=1)
        ctx.save_for_backward(out, targets, step)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """Adjoint of the recursion, from the last knot to the first."""
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


class Clip(torch.autograd.Function):
    """Clip to [low, high] with a gradient that can free what is stuck outside.

    The true derivative there is zero, so that a target beyond a bound would never be told to come
    back. Here it is told, if descent leads back inside.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Clip."""
        ctx.save_for_backward(value, low, high)
        return torch.minimum(torch.maximum(value, low), high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """Zero where descent would lead further outside."""
        (gradient,) = gradients
        value, low, high = ctx.saved_tensors
        outward = ((value > high) & (gradient < 0)) | ((value < low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None
