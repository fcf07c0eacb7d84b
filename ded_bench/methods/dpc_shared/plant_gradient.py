"""The linearised grid and the follower in torch: their adjoints are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ded_bench.methods.dpc_shared.adjoint_kernels import follow_all, follow_all_adjoint, swing_adjoint
from ded_bench.methods.dpc_shared.grid_response import FINE
from ded_bench.methods.dpc_shared.path_model import Linear, Outset, PathModel
from ded_bench.problem.case import Array


class Respond(torch.autograd.Function):
    """Angles, frequencies and slack power at the fine points from powers at the knots."""

    @staticmethod
    def forward(ctx: Any, powers: Tensor, model: PathModel, outset: Outset, linear: Linear) -> Any:
        """See `PathModel.respond`; (batch, n_knots, n_gen) to two (batch, n_fine, n_gen), (batch, n_fine)."""
        ctx.model, ctx.linear = model, linear
        x, omega, p_slack = model.respond(powers.detach().numpy().astype(np.float64), outset, linear)
        return tuple(map(_single, (x, omega, p_slack)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        """The transposed recursion."""
        model, linear = ctx.model, ctx.linear
        on_x, on_omega, on_slack = (part.numpy().astype(np.float64) for part in gradients)
        on_x = on_x - on_slack[:, :, None] * model.slack_stiffness(linear)
        shape, gain = model.response.shape, model.response.gain
        on_v = np.empty_like(on_omega)
        swing_adjoint(model.modes, linear.change, on_x @ shape.T, on_omega @ shape.T, on_v)
        fine = on_v @ gain.T
        found = fine[:, ::FINE].copy()
        for i in range(1, FINE):
            found[:, :-1] += (1 - i / FINE) * fine[:, i::FINE]
            found[:, 1:] += (i / FINE) * fine[:, i::FINE]
        return _single(found), None, None, None


def _single(values: Array) -> Tensor:
    """In single precision; where the linearised grid swings up without end, infinity."""
    with np.errstate(over="ignore"):
        return torch.from_numpy(values.astype(np.float32))


class FollowTargets(torch.autograd.Function):
    """Clip targets to bounds and follow them within ramps; knots, generators, batch.

    Where a target lies beyond a bound, its gradient is kept if descent leads back inside.
    """

    @staticmethod
    def forward(
        ctx: Any, targets: Tensor, p_initial: Tensor, low: Tensor, high: Tensor, step: Tensor
    ) -> Tensor:
        """Targets (n_gen, n_knots, batch), P_0 (n_gen, batch), limits (n_gen,)."""
        out = torch.empty_like(targets)
        limits = (low.numpy(), high.numpy(), step.numpy())
        follow_all(targets.detach().numpy(), p_initial.numpy(), *limits, out.numpy())
        ctx.save_for_backward(out, targets, low, high, step)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Adjoint of the recursion, from the last knot to the first."""
        out, targets, low, high, step = ctx.saved_tensors
        found = torch.empty_like(out)
        limits = (low.numpy(), high.numpy(), step.numpy())
        follow_all_adjoint(
            targets.numpy(), out.numpy(), *limits, gradients[0].contiguous().numpy(), found.numpy()
        )
        return found, None, None, None, None
