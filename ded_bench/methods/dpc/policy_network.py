"""The network of `ded-dpc`: stages that look at what a schedule would do and correct it.

Each stage sees the schedule so far, its `Response`, and the instance; its output moves the targets
that the follower tracks (in half ranges of each generator). A stage is a net of dilated residual
convolutions over the knots. Constants of the instance (costs, P_0, ω(0)) enter once, as a bias of
every layer. Here it is for training, in torch; `inference` is the same function for answers.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from ded_bench.methods.dpc.channels import Channels, Response, n_channels
from ded_bench.methods.dpc.inference import DILATIONS, EMBEDDING, STAGES, WIDTH
from ded_bench.methods.torch_follower import follow_within
from ded_bench.problem.case import Array, Case


class StagedNetwork(nn.Module):
    """Schedules from channels: corrected and followed once per stage; differentiable."""

    def __init__(self, case: Case, response: Response) -> None:
        super().__init__()
        n_gen, n_knots = len(case.generators), len(response.knots)
        n_sequence, n_constants = n_channels(case)
        n_seen = n_gen + response.n_outputs + n_sequence
        self.stages = nn.ModuleList(ResidualNetwork(n_seen, n_constants, n_gen) for _ in range(STAGES))
        self.response = response
        step = case.ramp * (response.knots[1] - response.knots[0])
        by_knot = response.of_power.reshape(n_gen, n_knots, -1, n_knots).transpose(1, 0, 3, 2)
        of_power = by_knot.reshape(n_knots * n_gen, -1)
        buffers = {"of_power": of_power, "low": case.p_min, "high": case.p_max, "step": step}
        for name, value in buffers.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32), persistent=False)

    of_power: Tensor  # as `Response.of_power`, powers and outputs knot by knot
    low: Tensor  # bounds, (n_gen,), pu
    high: Tensor
    step: Tensor  # largest change between two knots, (n_gen,), pu

    def normalise(self, channels: Channels) -> None:
        """Set the affine input normalisation of all stages from training data."""
        seen = self.response(channels.free_response, channels.start)
        sequence = np.concatenate([channels.start, seen, channels.sequence], axis=-1)
        for stage in self.stages:
            cast(ResidualNetwork, stage).normalise(sequence, channels.constants)

    def forward(self, start: Tensor, free: Tensor, sequence: Tensor, constants: Tensor) -> Tensor:
        """Powers at the knots, (batch, n_knots, n_gen), pu, from `Channels` in float32."""
        p_gen, half = start, 0.5 * (self.high - self.low)
        for stage in self.stages:
            seen = free + (p_gen.flatten(1) @ self.of_power).view_as(free)
            corrections = stage(torch.cat([p_gen, seen, sequence], dim=2), constants)
            targets = (p_gen + half * corrections)[:, 1:]
            p_gen = follow_within(targets, start[:, 0], self.low, self.high, self.step)
        return p_gen


class ResidualNetwork(nn.Module):
    """One stage: channels in, corrections out (in half ranges of each generator).

    Convolutions run along the second axis of images one pixel high: with channels stored last, as
    they come, that is a third faster to train on a CPU than one-dimensional convolutions.
    """

    def __init__(self, n_sequence: int, n_constants: int, n_gen: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(n_sequence, WIDTH, (1, 3), padding=(0, 1))
        self.embed = nn.Sequential(
            nn.Linear(n_constants, EMBEDDING), nn.ReLU(), nn.Linear(EMBEDDING, WIDTH * (1 + len(DILATIONS)))
        )
        self.spread = nn.ModuleList(
            nn.Conv2d(WIDTH, WIDTH, (1, 3), padding=(0, d), dilation=(1, d)) for d in DILATIONS
        )
        self.mix = nn.ModuleList(nn.Conv2d(WIDTH, WIDTH, 1) for _ in DILATIONS)
        self.last = nn.Conv2d(WIDTH, n_gen, 1)
        with torch.no_grad():
            for layer in self.mix:
                layer.weight.mul_(0.5)  # type: ignore[operator]
        nn.init.zeros_(self.last.weight)  # training starts from the schedule as it is
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]
        for name, n in (("sequence", n_sequence), ("constants", n_constants)):
            self.register_buffer(f"{name}_mean", torch.zeros(n))
            self.register_buffer(f"{name}_scale", torch.ones(n))

    sequence_mean: Tensor
    sequence_scale: Tensor
    constants_mean: Tensor
    constants_scale: Tensor

    def normalise(self, sequence: Array, constants: Array) -> None:
        """Set the affine input normalisation from training data, channels in the last axis."""
        for name, values in (("sequence", sequence), ("constants", constants)):
            rows = values.reshape(-1, values.shape[-1])
            getattr(self, f"{name}_mean").copy_(torch.as_tensor(rows.mean(axis=0)))
            getattr(self, f"{name}_scale").copy_(torch.as_tensor(rows.std(axis=0)).clamp_min(1e-6))

    def forward(self, sequence: Tensor, constants: Tensor) -> Tensor:
        """Corrections, shape (batch, n_knots, n_gen)."""
        x = ((sequence - self.sequence_mean) / self.sequence_scale).transpose(1, 2)[:, :, None]
        embedded = self.embed((constants - self.constants_mean) / self.constants_scale)
        bias = embedded.unflatten(1, (-1, WIDTH, 1, 1))
        h = self.first(x) + bias[:, 0]
        for i, (spread, mix) in enumerate(zip(self.spread, self.mix, strict=True)):
            h = h + mix(F.relu(spread(h) + bias[:, i + 1]))
        corrections: Tensor = self.last(F.relu(h))[:, :, 0].transpose(1, 2)
        return corrections
