"""The network of the shared policy: stages that look at what a schedule does and correct it.

All weights are shared by generators and knots. A generator sees its own limits, costs and frequency, the
slack's power, and in hidden layers weighted means over the other generators: by stiffness, by its
inverse, and all alike. Every input is a ratio without a unit. Tensors are (channel, generator, knot,
batch).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from ded_bench.methods.dpc_shared.grid_response import FINE, GridResponse
from ded_bench.methods.dpc_shared.path_model import Outset, PathModel
from ded_bench.methods.dpc_shared.plant_gradient import FollowTargets, Respond
from ded_bench.methods.dpc_shared.stage_records import CORRECTIONS, MIXED, Units
from ded_bench.methods.dpc_shared.unrolled_inference import (
    N_CONSTANT,
    N_MEMORY,
    N_SEQUENCE,
    TIMES,
    constants_of,
    dilations_of,
    times_of,
    units_of,
)
from ded_bench.problem.case import Array, Case


@dataclass(frozen=True, eq=False)
class Scales:
    """`Units` as tensors: (n_gen, 1, 1), and matrices (n_gen, n_gen)."""

    low: Tensor
    high: Tensor
    step: Tensor
    unit: Tensor
    pace: Tensor
    turn: float
    bound: float
    stiffness: Tensor
    compliance: Tensor
    by_stiffness: Tensor
    by_compliance: Tensor

    @staticmethod
    def of(units: Units) -> Scales:
        """Convert to float32."""
        columns = (units.low, units.high, units.step, units.unit, units.pace)
        matrices = (units.stiffness, units.compliance, units.by_stiffness, units.by_compliance)
        low, high, step, unit, pace = (torch.tensor(v, dtype=torch.float32)[:, None, None] for v in columns)
        whole = [torch.tensor(values, dtype=torch.float32) for values in matrices]
        return Scales(low, high, step, unit, pace, units.turn, units.bound, *whole)


def mix(matrix: Tensor, values: Tensor) -> Tensor:
    """A matrix over generators applied to (..., n_gen, n_knots, batch)."""
    return (matrix @ values.flatten(-2)).view_as(values)


def squash(values: Tensor) -> Tensor:
    """To (-1, 1)."""
    return values / (1.0 + values.abs())


def around(p_slack: Tensor) -> Tensor:
    """Means of (batch, n_fine) over the intervals before and after each knot, (1, n_knots, batch)."""
    means = p_slack[:, 1:].reshape(len(p_slack), -1, FINE).mean(dim=2)
    return (0.5 * (torch.cat([means[:, :1], means], 1) + torch.cat([means, means[:, -1:]], 1))).T[None]


def shifted(values: Tensor) -> Tensor:
    """Differences to the knot before, 0 at the first, along the axis of knots."""
    return F.pad(values.diff(dim=-2), (0, 0, 1, 0))


class Stage(nn.Module):
    """Channels in, corrections out."""

    def __init__(self, width: int, dilations: tuple[int, ...]):
        super().__init__()
        self.dilations = dilations
        n_in = N_SEQUENCE + N_MEMORY + N_CONSTANT
        self.first = nn.Parameter(torch.randn(width, 3 * (N_SEQUENCE + N_MEMORY)) * (2.0 / (3 * n_in)) ** 0.5)
        self.constant = nn.Parameter(torch.randn(width, N_CONSTANT) * (1.0 / n_in) ** 0.5)
        self.first_bias = nn.Parameter(torch.zeros(width))
        n = len(dilations)
        self.spread = nn.Parameter(torch.randn(n, width, 3 * width) * (2.0 / (3 * width)) ** 0.5)
        self.spread_bias = nn.Parameter(torch.zeros(n, width))
        self.mix = nn.Parameter(torch.randn(n, width, width + 3 * MIXED) * 0.5 * (1.0 / width) ** 0.5)
        self.mix_bias = nn.Parameter(torch.zeros(n, width))
        self.last = nn.Parameter(
            torch.cat([torch.zeros(CORRECTIONS, width), torch.randn(N_MEMORY, width) * 0.1])
        )
        self.last_bias = nn.Parameter(torch.zeros(CORRECTIONS + N_MEMORY))

    def forward(self, sequence: Tensor, constant: Tensor, scales: Scales) -> Tensor:
        """(channels, n_gen, n_knots, batch) to (CORRECTIONS + N_MEMORY, n_gen, n_knots, batch)."""
        n_gen = sequence.shape[1]
        own = self._product(self.constant, constant) + self.first_bias[:, None, None, None]
        h = _convolution(self.first, sequence, 1) + own
        for i, dilation in enumerate(self.dilations):
            z = _convolution(self.spread[i], h, dilation) + self.spread_bias[i, :, None, None, None]
            z = F.relu(z)
            pooled = z[2 * MIXED : 3 * MIXED].mean(dim=1, keepdim=True).expand(-1, n_gen, -1, -1)
            near = mix(scales.by_stiffness, z[:MIXED])
            far = mix(scales.by_compliance, z[MIXED : 2 * MIXED])
            h = h + self._product(self.mix[i], torch.cat([z, near, far, pooled]))
            h = h + self.mix_bias[i, :, None, None, None]
        return self._product(self.last, F.relu(h)) + self.last_bias[:, None, None, None]

    @staticmethod
    def _product(weight: Tensor, x: Tensor) -> Tensor:
        return (weight @ x.flatten(1)).view(-1, *x.shape[1:])


def _convolution(weight: Tensor, x: Tensor, dilation: int) -> Tensor:
    """Sum over each knot's neighbours at a distance, and itself; beyond both ends as at the ends.

    Args:
        weight: (n_out, 3 n_in): before, here, after.
        x: (n_in, n_gen, n_knots, batch).
        dilation: the distance, in knots.
    """
    n = x.shape[2]
    d = min(dilation, n - 1)
    by_tap = torch.cat(weight.chunk(3, dim=1)) @ x.flatten(1)  # shifting what comes out is cheaper
    before, here, after = by_tap.view(3, -1, *x.shape[1:]).unbind(0)
    left = torch.cat([before[:, :, :1].expand(-1, -1, d, -1), before[:, :, : n - d]], dim=2)
    right = torch.cat([after[:, :, d:], after[:, :, -1:].expand(-1, -1, d, -1)], dim=2)
    return here + left + right


@dataclass(frozen=True, eq=False)
class View:
    """What all stages of one batch see."""

    p_initial: Tensor  # (n_gen, batch)
    static: Tensor  # (n_gen, n_knots, batch), as the next
    fixed: Tensor
    cost: Tensor  # (1 + n_gen, 1, batch), in means of all
    constant: Tensor  # (N_CONSTANT, n_gen, n_knots, batch)


class UnrolledNetwork(nn.Module):
    """Schedules of problems: corrected and followed once per stage; differentiable."""

    def __init__(self, model: PathModel, stages: int, width: int):
        super().__init__()
        self.model = model
        self.units = units_of(model)
        self.scales = Scales.of(self.units)
        self.limits = [values[:, 0, 0] for values in (self.scales.low, self.scales.high, self.scales.step)]
        dilations = dilations_of(model.spacing)
        self.stages = nn.ModuleList(Stage(width, dilations) for _ in range(stages))
        self.shape = {"stages": stages, "width": width}

    def view(self, outset: Outset) -> View:
        """Tensors of a batch."""

        def tensor(values: Array) -> Tensor:
            return torch.as_tensor(values.T.copy(), dtype=torch.float32)

        static, fixed = (
            torch.as_tensor(values.transpose(2, 1, 0).copy(), dtype=torch.float32)
            for values in (outset.static, outset.fixed[:, ::FINE])
        )
        n_knots = static.shape[1]
        own, cost = constants_of(self.model, self.units, outset)
        constant = torch.as_tensor(own.transpose(1, 2, 0).copy(), dtype=torch.float32)[:, :, None]
        constant = constant.repeat(1, 1, n_knots, 1)
        constant[TIMES] = torch.as_tensor(times_of(n_knots), dtype=torch.float32)[:, None, :, None]
        return View(tensor(outset.problems.p_initial), static, fixed, tensor(cost)[:, None], constant)

    def sequence(self, view: View, p: Tensor, update: Tensor, omega: Tensor, p_slack: Tensor) -> Tensor:
        """Channels of a stage, (N_SEQUENCE, n_gen, n_knots, batch).

        Args:
            view: of the batch.
            p: the schedule, (n_gen, n_knots, batch).
            update: the last correction, likewise.
            omega: at the fine points, (batch, n_fine, n_gen).
            p_slack: (batch, n_fine).
        """
        s, u = self.scales, self.scales.unit
        batch, _, n_gen = omega.shape
        inside = (omega[:, 1:] / s.bound).clamp(-3.0, 3.0).view(batch, -1, FINE, n_gen)
        first = (omega[:, :1] / s.bound).clamp(-3.0, 3.0)
        most = torch.cat([first, inside.amax(dim=2)], dim=1).permute(2, 1, 0)
        least = torch.cat([first, inside.amin(dim=2)], dim=1).permute(2, 1, 0)
        slack = torch.cat([p_slack[:, :1], p_slack[:, 1:].view(batch, -1, FINE).mean(dim=2)], dim=1).T[None]
        at_knot = p_slack[:, ::FINE].T[None]
        missing = view.static - p
        angle = mix(s.compliance, missing) / s.turn
        sign = squash(4.0 * slack / u)
        price = view.cost[1:] - view.cost[:1] * sign
        own = torch.diagonal(s.stiffness)[:, None, None]
        fixed = shifted(view.fixed)
        return torch.stack(
            [
                (2.0 * p - s.low - s.high) / (s.high - s.low),
                squash(0.5 * (p - s.low) / u),
                squash(0.5 * (s.high - p) / u),
                squash(missing / (2.0 * u)),
                squash(missing / (20.0 * u)),
                shifted(p) / s.step,
                squash(shifted(p) / u),
                squash(shifted(view.static) / u),
                squash(angle / 2.0),
                squash(angle / 20.0),
                most,
                least,
                squash(slack / u),
                squash(slack / (10.0 * u)),
                squash(at_knot / u),
                price,
                mix(s.stiffness, price) / own,
                squash(2.0 * update / u),
                squash(4.0 * fixed / u),
                squash(2.0 * mix(s.by_stiffness, shifted(p) / u)),
            ]
        )

    def forward(self, outset: Outset) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Schedules after each stage, with what they do.

        Returns:
            Of each stage: powers (batch, n_knots, n_gen), ω (batch, n_fine, n_gen), P_s (batch, n_fine).
        """
        s, model, view = self.scales, self.model, self.view(outset)
        powers = torch.as_tensor(outset.start, dtype=torch.float32)
        p = powers.permute(2, 1, 0)
        linear = model.linearise(outset, model.start_path(outset))
        _, omega, p_slack = Respond.apply(powers, model, outset, linear)  # type: ignore[no-untyped-call]
        memory, update = p.new_zeros(N_MEMORY, *p.shape), torch.zeros_like(p)
        found = []
        for number, stage in enumerate(self.stages, start=1):
            sequence = self.sequence(view, p, update, omega, p_slack)
            out = stage(torch.cat([sequence, memory]), view.constant, s)
            change = 2.0 * s.unit * out[0] + s.turn * mix(s.stiffness, out[1])
            change = change + out[2] * around(p_slack) + out[3] * (view.static - p)
            change = s.pace * change
            before, memory = p, out[CORRECTIONS:]
            p = FollowTargets.apply(p + change, view.p_initial, *self.limits)  # type: ignore[no-untyped-call]
            update = p - before
            powers = p.permute(2, 1, 0)
            if number == len(self.stages):
                x = model.respond(powers.detach().numpy().astype(np.float64), outset, linear)[0]
                linear = model.along(outset, x)
            _, omega, p_slack = Respond.apply(powers, model, outset, linear)  # type: ignore[no-untyped-call]
            found.append((powers, omega, p_slack))
        return found


def build(case: Case, regime: str, horizon_s: float, stages: int, width: int) -> UnrolledNetwork:
    """A network for a case, regime and horizon."""
    response = GridResponse.make(case, case.knot_times(horizon_s))
    return UnrolledNetwork(PathModel(case, case.omega_bound(regime), response), stages, width)
