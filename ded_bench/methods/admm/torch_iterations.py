"""The ADMM of `ded-admm` in torch, for training, and its loss; adjoints of the grid are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ded_bench.methods.admm.admm_inference import (
    DOUBLING,
    MOST,
    NODES,
    PENALTIES,
    SETTINGS,
    STRAIGHT,
    between_nodes,
    limits_of,
    mean_modes_of,
    starting_settings,
)
from ded_bench.methods.admm.modal_grid import ModalGrid, ModalLinearisation, Start, linear_between
from ded_bench.methods.admm.modal_kernels import MeanModes, modal_change, swing, swing_adjoint
from ded_bench.methods.admm.problems import POINTS
from ded_bench.methods.training_run import follow_within
from ded_bench.problem.case import Array

#: By what part of it a weight is changed for a difference quotient; all is in double precision.
QUOTIENT = 1e-6
#: Powers (batch, n_knots, n_gen), ω (batch, n_points, n_gen) and P_s (batch, n_points).
Answer = tuple[Tensor, Tensor, Tensor]


class TorchIterations(nn.Module):
    """All iterations for one case, bound and horizon; only `nodes` are learned."""

    def __init__(self, grid: ModalGrid, iterations: int) -> None:
        super().__init__()
        self.grid = grid
        self.nodes = nn.Parameter(torch.zeros(NODES, len(SETTINGS)))
        self.start, self.between = _single(starting_settings(iterations)), _single(between_nodes(iterations))

    def settings(self) -> Tensor:
        """See `admm_inference.settings_of`."""
        columns = list((self.start * (self.between @ self.nodes).exp()).unbind(dim=1))
        for name, most in MOST.items():
            i = list(SETTINGS).index(name)
            columns[i] = columns[i] * most / (most - self.start[:, i] + columns[i])
        return torch.stack(columns, dim=1)

    def forward(self, start: Start) -> Answer:
        """Schedules after the last iteration, within their limits, and what they do."""
        grid, limits = self.grid, limits_of(self.grid, self.grid.bound)
        linear = grid.along_first(start)
        modes = mean_modes_of(grid, linear)
        low, high, step, mass = map(_single, (limits.low, limits.high, limits.step, limits.mass))
        by_mass, n = 1.0 / (mass * limits.unit**2), start.schedule.shape[1]
        cost = _single(start.problems.cost / start.scale[:, None])
        at_knots, at_points = means_over_time(n), means_over_time(POINTS * (n - 1) + 1)
        price = cost[:, :1] * at_points
        own = at_knots[1:, None] * cost[:, None, 1:]
        p = _single(start.schedule)
        copies: list[Tensor] = []
        duals = [torch.zeros(())] * 4
        for setting in self.settings() * torch.tensor([limits.price] * PENALTIES + [1.0] * 4):
            omega, p_slack = Respond.apply(p, grid, start, linear)  # type: ignore[no-untyped-call]
            heavy = setting[3] / (limits.unit**2 * POINTS)
            steady = setting[2] / (limits.bound**2 * POINTS)
            weights = setting[0] * by_mass, setting[1] * by_mass, steady, heavy
            now = [p[:, 1:], p.diff(dim=1), omega, p_slack]
            if not copies:
                copies = [values.detach() for values in now]
            relaxed, tight = setting[6], limits.bound * (1.0 - setting[7])
            wanted = [
                relaxed * a + (1.0 - relaxed) * z + y / w
                for a, z, y, w in zip(now, copies, duals, weights, strict=True)
            ]
            copies = [
                torch.minimum(torch.maximum(wanted[0], low), high),
                torch.minimum(torch.maximum(wanted[1], -step), step),
                torch.minimum(torch.maximum(wanted[2], -tight), tight),
                (wanted[3] - price / heavy).relu() - (-wanted[3] - price / heavy).relu(),
            ]
            duals = [w * (a - z) for w, a, z in zip(weights, wanted, copies, strict=True)]
            forces = [y + w * (a - z) for y, w, a, z in zip(duals, weights, now, copies, strict=True)]
            gradient = own + forces[0] + forces[1] - nn.functional.pad(forces[1][:, 1:], (0, 0, 0, 1))
            gradient = nn.functional.pad(gradient, (0, 0, 1, 0))
            gradient = gradient + Transposed.apply(forces[2], forces[3], grid, linear)  # type: ignore[no-untyped-call]
            quadratic = torch.stack(
                [
                    setting[0] / limits.unit**2,
                    setting[1] / limits.unit**2,
                    setting[2] * setting[4] / (limits.bound**2 * POINTS),
                    heavy * setting[5],
                ]
            )
            p = p + ModalChange.apply(gradient, quadratic, modes)  # type: ignore[no-untyped-call]
        p = follow_within(p[:, 1:], _single(start.problems.p_initial), low, high, step)
        x = grid.respond(_double(p), start, linear)[0]
        omega, p_slack = Respond.apply(p, grid, start, grid.along(start, x))  # type: ignore[no-untyped-call]
        return p, omega, p_slack


def judged(
    grid: ModalGrid, start: Start, answer: Answer, margin: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Judge answers to problems by what they do; everything but the bound on |ω| holds by construction.

    Args:
        grid: has the bound.
        start: of the problems.
        answer: to them.
        margin: by what part of it the bound is tightened.

    Returns:
        Cost as a part of `Start.scale`, penalty, and largest relative excess of |ω|, (batch,) each.
    """
    powers, omega, p_slack = answer
    cost = torch.as_tensor(start.problems.cost, dtype=torch.float32)
    at_knots, at_points = means_over_time(powers.shape[1]), means_over_time(p_slack.shape[1])
    generators = ((powers * cost[:, None, 1:]).sum(dim=2) * at_knots).sum(dim=1)
    total = generators + cost[:, 0] * (p_slack.abs() * at_points).sum(dim=1)
    excess = (omega.abs() / grid.bound - (1.0 - margin)).relu()
    bent = excess.clamp_max(STRAIGHT)
    penalty = (excess + (excess - 0.5 * bent) * bent / DOUBLING).sum(dim=(1, 2)) * float(grid.points[1])
    scale = torch.as_tensor(start.scale, dtype=torch.float32)
    return total / scale, penalty, excess.amax(dim=(1, 2))


class Respond(torch.autograd.Function):
    """Frequencies and slack power on the time grid from powers at the knots."""

    @staticmethod
    def forward(ctx: Any, powers: Tensor, grid: ModalGrid, start: Start, linear: ModalLinearisation) -> Any:
        """See `ModalGrid.respond`; (batch, n_knots, n_gen) to (batch, n_points, n_gen), (batch, n_points)."""
        ctx.grid, ctx.linear = grid, linear
        _, omega, p_slack = grid.respond(_double(powers), start, linear)
        return _single(omega), _single(p_slack)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        """The transposed recursion."""
        return _single(_transposed(ctx.grid, ctx.linear, *map(_double, gradients))), None, None, None


class Transposed(torch.autograd.Function):
    """What gradients in ω and P_s on the time grid are in powers at the knots."""

    @staticmethod
    def forward(
        ctx: Any, on_omega: Tensor, on_slack: Tensor, grid: ModalGrid, linear: ModalLinearisation
    ) -> Tensor:
        """(batch, n_points, n_gen) and (batch, n_points) to (batch, n_knots, n_gen)."""
        ctx.grid, ctx.linear = grid, linear
        return _single(_transposed(grid, linear, _double(on_omega), _double(on_slack)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """The response itself, from rest and without loads."""
        grid, linear = ctx.grid, ctx.linear
        v = linear_between(_double(gradients[0]) @ grid.gain, POINTS)
        q, speed = np.zeros_like(v), np.zeros_like(v)
        for b in range(len(v)):
            swing(grid.modes, linear.change[b], v[b], q[b], speed[b])
        on_slack = -(grid.slack_stiffness(linear) * (q @ grid.shape)).sum(axis=2)
        return _single(speed @ grid.shape), _single(on_slack), None, None


class ModalChange(torch.autograd.Function):
    """Change of powers that minimises the quadratic model of an iteration."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, weights: Tensor, modes: MeanModes) -> Tensor:
        """See `modal_change`; gradient (batch, n_knots, n_gen), weights (4,), modes of `mean_modes_of`."""
        ctx.modes, ctx.gradient, ctx.weights = modes, _double(gradient), _double(weights)
        ctx.change = _changes(ctx.gradient, ctx.weights, modes)
        return _single(ctx.change)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        """Another solution with the same, symmetric, matrix; for the weights, difference quotients."""
        on_change, on_weights = _double(gradients[0]), np.empty(4)
        for i, more in enumerate(QUOTIENT * ctx.weights):
            weights = ctx.weights.copy()
            weights[i] += more
            change = _changes(ctx.gradient, weights, ctx.modes) - ctx.change
            on_weights[i] = (on_change * change).sum() / more
        return _single(_changes(on_change, ctx.weights, ctx.modes)), _single(on_weights), None


def means_over_time(n: int) -> Tensor:
    """Weights, (n,), of the mean over time of what is linear between n equidistant points."""
    weights = torch.full((n,), 1.0 / (n - 1))
    weights[[0, -1]] *= 0.5
    return weights


def _transposed(grid: ModalGrid, linear: ModalLinearisation, on_omega: Array, on_slack: Array) -> Array:
    """Gradient in powers at the knots from those in ω and P_s on the time grid."""
    on_x = -on_slack[:, :, None] * grid.slack_stiffness(linear)
    on_v = np.empty_like(on_omega)
    on_q, on_speed = on_x @ grid.shape.T, on_omega @ grid.shape.T
    for b in range(len(on_v)):
        swing_adjoint(grid.modes, linear.change[b], on_q[b], on_speed[b], on_v[b])
    found = on_v[:, ::POINTS].copy()
    for i in range(1, POINTS):
        found[:, :-1] += (1 - i / POINTS) * on_v[:, i::POINTS]
        found[:, 1:] += (i / POINTS) * on_v[:, i::POINTS]
    return np.asarray(found @ grid.gain.T)


def _changes(gradient: Array, weights: Array, modes: MeanModes) -> Array:
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
