"""Train `ded-dpc` on instances drawn afresh: no solution is needed, only the condensed rollout.

Each stage of the network sees the schedule so far, its `Response`, and the instance; its output moves the
targets that the follower tracks (in half ranges of each generator). A stage is a net of dilated residual
convolutions over the knots. Constants of the instance (costs, P_0, ω(0)) enter once, as a bias of every
layer. Here it is in torch; `inference` is the same function for answers.

The loss is the cost and an exact penalty on the frequency bound, both by a surrogate at every tenth of a
second; everything else holds by construction (see `knots.track`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from ded_bench.methods.dpc.channels import Channels, Response, n_channels
from ded_bench.methods.dpc.dpc_policy import DispatchPolicy
from ded_bench.methods.dpc.inference import DILATIONS, EMBEDDING, STAGES, WIDTH
from ded_bench.methods.dpc.refinement import coarse_free_response
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.trained_policy import Scope, weights_of
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.methods.training_run import TrainingRun, follow_within, looked, repeatable
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import largest_divisor
from ded_bench.problem.sampling import POLICY_SEED, sample_instances
from ded_bench.surrogates.koopman import CondensedRollout, Koopman

#: Fresh instances, epochs over them, batch size.
FRESH, EPOCHS, BATCH = 64_000, 32, 128
LEARNING_RATE, WEIGHT_DECAY = 6e-3, 1e-4
#: Spacing of the points at which P_s and ω are evaluated, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.1
#: The policy is trained on a bound tighter by this fraction, so that small excesses stay within the true one.
MARGIN = 0.02
#: Price of one relative unit of excess of |ω| for one second, as a fraction of the instance's cost: an
#: exact penalty, above nearly all of the optimum's multipliers. It grows from the first to the second.
PRICE = (0.01, 0.08)
#: Relative excess at which the price has doubled: rare large excesses count for more than many small ones.
#: It, MARGIN and PRICE were chosen on validation instances (studies/dpc.md).
DOUBLING = 0.05
#: The part of the instances with the largest excess is seen this many times more in the next epoch.
HARD, REPEATS = 0.02, 5
#: Costs are relative to the static dispatch, but an instance is not worth more than this mean cost per point.
SMALLEST_COST = 0.05
#: A training that is to end soon draws no more fresh instances than so many per second.
FRESH_PER_SECOND = 200
#: Instances rolled out at once.
CHUNK = 500


class StagedNetwork(nn.Module):
    """Schedules from channels: corrected and followed once per stage; differentiable."""

    def __init__(self, case: Case, response: Response) -> None:
        super().__init__()
        n_gen, n_knots = len(case.generators), len(response.knots)
        n_sequence, n_constants = n_channels(case)
        n_seen = n_gen + response.n_outputs + n_sequence
        self.stages = nn.ModuleList(ResidualNetwork(n_seen, n_constants, n_gen) for _ in range(STAGES))
        self.response = response
        by_knot = response.of_power.reshape(n_gen, n_knots, -1, n_knots).transpose(1, 0, 3, 2)
        #: As `Response.of_power`, powers and outputs knot by knot.
        self.of_power = torch.tensor(by_knot.reshape(n_knots * n_gen, -1), dtype=torch.float32)
        #: Bounds, and the largest change between two knots, (n_gen,), pu.
        limits = case.p_min, case.p_max, case.ramp * (response.knots[1] - response.knots[0])
        self.low, self.high, self.step = (torch.tensor(limit, dtype=torch.float32) for limit in limits)

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
            targets = (p_gen + half * stage(torch.cat([p_gen, seen, sequence], dim=2), constants))[:, 1:]
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
        self.sequence_mean = nn.Buffer(torch.zeros(n_sequence))
        self.sequence_scale = nn.Buffer(torch.ones(n_sequence))
        self.constants_mean = nn.Buffer(torch.zeros(n_constants))
        self.constants_scale = nn.Buffer(torch.ones(n_constants))

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


class Pool(NamedTuple):
    """Instances as tensors, ready for the loss; the first four are what a StagedNetwork takes."""

    start: Tensor  # (batch, n_knots, n_gen), pu
    free_response: Tensor  # of the linearisation, at the knots, (batch, n_knots, n_outputs)
    sequence: Tensor  # (batch, n_knots, n_sequence)
    constants: Tensor  # (batch, n_constants)
    cost: Tensor  # (batch, 1 + n_gen)
    scale: Tensor  # (batch,): what costs are relative to
    coarse_free_response: Tensor  # of the surrogate, (batch, n_gen + 1, n_coarse)

    @staticmethod
    def of(channels: Channels, inputs: StackedInstances, model: Koopman, grid: Array) -> Pool:
        """Convert channels, and compute free responses on a time grid; float32."""
        stride = largest_divisor(len(grid) - 1, round(SPACING_S / model.dt_s))
        parts = [inputs[start : start + CHUNK] for start in range(0, len(inputs), CHUNK)]
        free = [coarse_free_response(model, part, grid, stride) for part in parts]
        scale = np.maximum(channels.static_cost(inputs), SMALLEST_COST) * len(grid)
        seen = channels.start, channels.free_response, channels.sequence, channels.constants
        arrays = (*seen, inputs.cost, scale, np.concatenate(free))
        whole = (np.ascontiguousarray(array) for array in arrays)
        return Pool(*(torch.as_tensor(array, dtype=torch.float32) for array in whole))


class RolloutLoss:
    """Relative cost and frequency excess of schedules, by a surrogate on the coarse points."""

    def __init__(self, condensed: CondensedRollout, omega_bound: float) -> None:
        gamma = condensed.gamma.reshape(-1, condensed.gamma.shape[2])
        arrays = gamma, condensed.hat_weights, condensed.quadrature_weights
        self.gamma, self.hat_weights, self.quadrature_weights = (
            torch.as_tensor(array, dtype=torch.float32) for array in arrays
        )
        self.n_gen, self.omega_bound = len(condensed.gamma) - 1, omega_bound
        self.spacing_s = condensed.stride * condensed.model.dt_s

    def __call__(self, powers: Tensor, pool: Pool, margin: float = 0.0) -> tuple[Tensor, Tensor]:
        """Cost relative to the scale, (batch,), and relative excess of |ω|, (batch, n_gen, n_coarse)."""
        free = pool.coarse_free_response
        out = free + (powers.flatten(1) @ self.gamma.T).view_as(free)
        omega, p_slack = out[:, : self.n_gen], out[:, self.n_gen]
        generators = (torch.einsum("bkg,k->bg", powers, self.hat_weights) * pool.cost[:, 1:]).sum(dim=1)
        cost = generators + pool.cost[:, 0] * (p_slack.abs() @ self.quadrature_weights)
        return cost / pool.scale, (omega.abs() / self.omega_bound - (1.0 - margin)).relu()


@repeatable()
def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> DispatchPolicy:
    """Train a policy; see `training_record.Trainer`.

    Args:
        instances: choose the best weights and are never trained on; they share one time grid and horizon.
    """
    model, first = options.find_model(case), instances[0]
    model.check_step(first)
    scope = Scope(case, regime, first.horizon_s)
    response = Response.make(case, case.knot_times(first.horizon_s))
    fresh = FRESH if options.seconds is None else min(FRESH, math.ceil(FRESH_PER_SECOND * options.seconds))
    drawn = list(sample_instances(case, POLICY_SEED + options.seed, fresh, servable=servable))
    inputs = [StackedInstances.of(case, part) for part in (drawn, instances)]
    channels = [Channels.of(case, part, response) for part in inputs]
    data, check = (Pool.of(c, i, model, first.grid) for c, i in zip(channels, inputs, strict=True))
    stride = largest_divisor(first.steps, round(SPACING_S / model.dt_s))
    condensed = CondensedRollout.make(model, first.grid, response.knots, stride)
    with torch.random.fork_rng():
        torch.manual_seed(options.seed)
        staged = StagedNetwork(case, response)
    staged.normalise(channels[0])
    loss = RolloutLoss(condensed, case.omega_bound(regime))
    run = _DispatchTraining(staged, loss, data, check, options.seed, out)
    title = f"{DispatchPolicy.method} {regime}"
    facts = run.train(options, EPOCHS, title, case.fingerprint, model.fingerprint) | {
        "instances": len(drawn),
        "held_out": len(instances),
        "model": model.kind,
        "model_fingerprint": model.fingerprint,
    }
    policy = DispatchPolicy(scope, weights_of(staged), facts)
    policy.save(out)
    return policy


class _DispatchTraining(TrainingRun):
    progress = (*TrainingRun.progress, "penalty")

    def __init__(
        self, network: StagedNetwork, loss: RolloutLoss, data: Pool, check: Pool, seed: int, out: Path
    ) -> None:
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, betas=(0.9, 0.99), fused=True
        )
        super().__init__(network, optimiser, seed, out)
        self.judge, self.data, self.check = loss, data, check
        self.penalty = torch.zeros(len(data.cost))  # of each instance when it was last seen

    def load(self) -> None:
        """See `TrainingRun.load`; there may be more instances than then, or fewer."""
        super().load()
        known, self.penalty = self.penalty, torch.zeros(len(self.data.cost))
        count = min(len(known), len(self.penalty))
        self.penalty[:count] = known[:count]

    def batches(self) -> Sequence[Tensor]:
        """Rows of the next epoch: all, the hard ones repeatedly, shuffled."""
        worst = torch.topk(self.penalty, round(HARD * len(self.penalty))).indices
        worst = worst[self.penalty[worst] > 0]
        rows = torch.cat([torch.arange(len(self.penalty)), worst.repeat(REPEATS)])
        return torch.split(rows[torch.randperm(len(rows), generator=self.generator)], BATCH)

    def loss(self, rows: Tensor, progress: float) -> Tensor:
        """Cost and priced penalty of a batch."""
        batch = Pool(*(part[rows] for part in self.data))
        cost, excess = self.judge(self.network(*batch[:4]), batch, MARGIN)
        penalty = _penalty(excess)
        self.penalty[rows] = penalty.detach()
        price = PRICE[0] * (PRICE[1] / PRICE[0]) ** progress * self.judge.spacing_s
        total: Tensor = cost.mean() + price * penalty.mean()
        return total

    def look(self) -> dict[str, float]:
        """Loss of the average at the last price, its cost, and what it exceeds, Hz."""
        powers = self.average(*self.check[:4])
        cost, excess = self.judge(powers, self.check)
        _, tight = self.judge(powers, self.check, MARGIN)
        value = cost.mean() + PRICE[1] * self.judge.spacing_s * _penalty(tight).mean()
        return looked(value, cost, excess.amax(dim=(1, 2)) * self.judge.omega_bound / (2 * math.pi))


def _penalty(excess: Tensor) -> Tensor:
    """Exact (first-order) penalty with a second-order part, shape (batch,)."""
    return (excess + excess.square() / (2.0 * DOUBLING)).sum(dim=(1, 2))
