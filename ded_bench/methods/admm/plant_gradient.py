"""The linearised grid, the follower and the quadratic model in torch: their adjoints are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ded_bench.methods.admm.adjoint_kernels import modal_products, track_rows_adjoint
from ded_bench.methods.admm.grid_response import FINE
from ded_bench.methods.admm.iteration_kernels import modal_change, swing, swing_adjoint, track_rows
from ded_bench.methods.admm.path_model import Linear, Outset, PathModel, linear_between
from ded_bench.problem.case import Array


class Respond(torch.autograd.Function):
    """Angles, frequencies and slack power at the fine points from powers at the knots."""

    @staticmethod
    def forward(ctx: Any, powers: Tensor, model: PathModel, outset: Outset, linear: Linear) -> Any:
        """See `PathModel.respond`; (batch, n_knots, n_gen) to two (batch, n_fine, n_gen), (batch, n_fine)."""
        ctx.model, ctx.linear = model, linear
        x, omega, p_slack = model.respond(_double(powers), outset, linear)
        return tuple(map(_single, (x, omega, p_slack)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        """The transposed recursion."""
        return _single(_transposed(ctx.model, ctx.linear, *map(_double, gradients))), None, None, None


class Transposed(torch.autograd.Function):
    """What gradients in ω and P_s at the fine points are in powers at the knots."""

    @staticmethod
    def forward(ctx: Any, on_omega: Tensor, on_slack: Tensor, model: PathModel, linear: Linear) -> Tensor:
        """(batch, n_fine, n_gen) and (batch, n_fine) to (batch, n_knots, n_gen)."""
        ctx.model, ctx.linear = model, linear
        on_x = np.zeros(on_omega.shape)
        return _single(_transposed(model, linear, on_x, _double(on_omega), _double(on_slack)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """The response itself, from rest and without loads."""
        model, linear = ctx.model, ctx.linear
        response = model.response
        v = linear_between(_double(gradients[0]) @ response.gain, FINE)
        q, speed = np.zeros_like(v), np.zeros_like(v)
        swing(model.modes, linear.change, v, q, speed)
        on_slack = -(model.slack_stiffness(linear) * (q @ response.shape)).sum(axis=2)
        return _single(speed @ response.shape), _single(on_slack), None, None


class ModalChange(torch.autograd.Function):
    """Change of powers that minimises the quadratic model of an iteration."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, weights: Tensor, modes: tuple[Array, Array, Array]) -> Tensor:
        """See `modal_change`; gradient (batch, n_knots, n_gen), weights (4,), modes of `mean_modes_of`."""
        ctx.modes, ctx.weights = modes, _double(weights)
        change = _changes(_double(gradient), ctx.weights, modes)
        ctx.change = change
        return _single(change)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        """Another solution with the same, symmetric, matrix; for the weights, its parts between both."""
        modes, maps, outputs = ctx.modes
        on_gradient = _changes(_double(gradients[0]), ctx.weights, ctx.modes)
        back = np.linalg.inv(modes.swapaxes(1, 2))
        on_weights = np.zeros(4)
        modal_products(maps, outputs, on_gradient @ back, ctx.change @ back, on_weights)
        return _single(on_gradient), _single(on_weights), None


class FollowTargets(torch.autograd.Function):
    """Clip targets to bounds and follow them within ramps; batch, knots, generators.

    Where a target lies beyond a bound, its gradient is kept if descent leads back inside.
    """

    @staticmethod
    def forward(
        ctx: Any, targets: Tensor, p_initial: Tensor, low: Tensor, high: Tensor, step: Tensor
    ) -> Tensor:
        """Targets (batch, n_knots, n_gen), P_0 (batch, n_gen), limits (n_gen,)."""
        ctx.limits = _double(low), _double(high), _double(step)
        ctx.targets = _double(targets)
        ctx.powers = ctx.targets.copy()
        ctx.powers[:, 0] = _double(p_initial)
        track_rows(ctx.powers, *ctx.limits)
        return _single(ctx.powers)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None, None]:
        """Gradient in the targets."""
        on_targets, (low, high, step) = np.zeros(ctx.targets.shape), ctx.limits
        track_rows_adjoint(ctx.targets, ctx.powers, low, high, step, _double(gradients[0]), on_targets)
        return _single(on_targets), None, None, None, None


def _transposed(model: PathModel, linear: Linear, on_x: Array, on_omega: Array, on_slack: Array) -> Array:
    """Gradient in powers at the knots from those in x, ω and P_s at the fine points."""
    on_x = on_x - on_slack[:, :, None] * model.slack_stiffness(linear)
    shape = model.response.shape
    on_v = np.empty_like(on_omega)
    swing_adjoint(model.modes, linear.change, on_x @ shape.T, on_omega @ shape.T, on_v)
    found = on_v[:, ::FINE].copy()
    for i in range(1, FINE):
        found[:, :-1] += (1 - i / FINE) * on_v[:, i::FINE]
        found[:, 1:] += (i / FINE) * on_v[:, i::FINE]
    return np.asarray(found @ model.response.gain.T)


def _changes(gradient: Array, weights: Array, modes: tuple[Array, Array, Array]) -> Array:
    """`modal_change` of a batch, in powers."""
    into, maps, outputs = modes
    found = np.empty_like(gradient)
    for b in range(len(gradient)):
        modal_change(maps[b], outputs[b], weights, gradient[b] @ into[b], found[b])
    return np.asarray(found @ into.swapaxes(1, 2))


def _double(values: Tensor) -> Array:
    return values.detach().numpy().astype(np.float64)


def _single(values: Array) -> Tensor:
    """In single precision; where the linearised grid swings up without end, infinity."""
    with np.errstate(over="ignore"):
        return torch.from_numpy(values.astype(np.float32))
