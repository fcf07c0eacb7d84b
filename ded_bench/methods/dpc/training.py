"""Train `ded-dpc` on instances drawn afresh: no solution is needed, only the condensed rollout.

The loss is the cost and an exact penalty on the frequency bound, both by a surrogate at every tenth of a
second; everything else holds by construction (see `ramp_follower`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ded_bench.methods.dpc.channels import Channels, Response
from ded_bench.methods.dpc.dpc_policy import DispatchPolicy
from ded_bench.methods.dpc.policy_network import StagedNetwork
from ded_bench.methods.dpc.refinement import coarse_free_response, coarse_stride
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.trained_policy import Scope, weights_of
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.methods.training_run import TrainingRun, repeatable
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instances
from ded_bench.surrogates.condensed import CondensedRollout
from ded_bench.surrogates.koopman import Koopman

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
#: It, MARGIN and PRICE were chosen on validation instances (docs/model.md).
DOUBLING = 0.05
#: The part of the instances with the largest excess is seen this many times more in the next epoch.
HARD, REPEATS = 0.02, 5
#: Costs are relative to the static dispatch, but an instance is not worth more than this mean cost per point.
SMALLEST_COST = 0.05
#: A training that is to end soon draws no more fresh instances than so many per second.
FRESH_PER_SECOND = 200
#: Instances rolled out at once.
CHUNK = 500


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
    def of(
        channels: Channels,
        inputs: StackedInstances,
        model: Koopman,
        network: Network,
        grid: Array,
        device: str,
    ) -> Pool:
        """Convert channels, and compute free responses on a time grid; float32."""
        stride = coarse_stride(model.dt_s, len(grid) - 1, SPACING_S)
        parts = [inputs[start : start + CHUNK] for start in range(0, len(inputs), CHUNK)]
        free = [coarse_free_response(network, model, part, grid, stride) for part in parts]
        scale = np.maximum(channels.static_cost(inputs), SMALLEST_COST) * len(grid)
        seen = channels.start, channels.free_response, channels.sequence, channels.constants
        arrays = (*seen, inputs.cost, scale, np.concatenate(free))
        whole = (np.ascontiguousarray(array) for array in arrays)
        return Pool(*(torch.as_tensor(array, dtype=torch.float32, device=device) for array in whole))

    def of_rows(self, rows: Tensor) -> Pool:
        """Some of them."""
        return Pool(*(part[rows] for part in self))


class RolloutLoss:
    """Relative cost and frequency excess of schedules, by a surrogate on the coarse points."""

    def __init__(self, condensed: CondensedRollout, omega_bound: float, device: str) -> None:
        gamma = condensed.gamma.reshape(-1, condensed.gamma.shape[2])
        arrays = gamma, condensed.hat_weights, condensed.quadrature_weights
        self.gamma, self.hat_weights, self.quadrature_weights = (
            torch.as_tensor(array, dtype=torch.float32).to(device) for array in arrays
        )
        self.n_gen, self.omega_bound = condensed.n_gen, omega_bound
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
    model, first, network = options.find_model(case), instances[0], Network(case)
    scope = Scope(case, regime, first.horizon_s)
    response = Response.make(case, case.knot_times(first.horizon_s))
    fresh = FRESH if options.seconds is None else min(FRESH, math.ceil(FRESH_PER_SECOND * options.seconds))
    drawn = list(sample_instances(case, POLICY_SEED + options.seed, fresh, servable=servable))
    inputs = [StackedInstances.of(case, part) for part in (drawn, instances)]
    channels = [Channels.of(case, part, response) for part in inputs]
    data, check = (
        Pool.of(c, i, model, network, first.grid, options.device)
        for c, i in zip(channels, inputs, strict=True)
    )
    stride = coarse_stride(model.dt_s, first.steps, SPACING_S)
    condensed = CondensedRollout.make(case, model, first.grid, response.knots, stride)
    with torch.random.fork_rng():
        torch.manual_seed(options.seed)
        staged = StagedNetwork(case, response)
    staged.normalise(channels[0])
    staged.to(options.device)
    loss = RolloutLoss(condensed, case.omega_bound(regime), options.device)
    run = _DispatchTraining(staged, loss, data, check, options.seed, out)
    facts = run.train(options, EPOCHS, f"{DispatchPolicy.method} {regime}") | {
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

    def batches(self) -> Sequence[Tensor]:
        """Rows of the next epoch: all, the hard ones repeatedly, shuffled."""
        worst = torch.topk(self.penalty, round(HARD * len(self.penalty))).indices
        worst = worst[self.penalty[worst] > 0]
        rows = torch.cat([torch.arange(len(self.penalty)), worst.repeat(REPEATS)])
        return torch.split(rows[torch.randperm(len(rows), generator=self.generator)], BATCH)

    def loss(self, rows: Tensor, progress: float) -> Tensor:
        """Cost and priced penalty of a batch."""
        batch = self.data.of_rows(rows.to(self.data.start.device))
        cost, excess = self.judge(self.network(*batch[:4]), batch, MARGIN)
        penalty = _penalty(excess)
        self.penalty[rows] = penalty.detach().cpu()
        price = PRICE[0] * (PRICE[1] / PRICE[0]) ** progress * self.judge.spacing_s
        total: Tensor = cost.mean() + price * penalty.mean()
        return total

    def look(self) -> dict[str, float]:
        """Loss of the average at the last price, its cost, and what it exceeds, Hz."""
        powers = self.average(*self.check[:4])
        cost, excess = self.judge(powers, self.check)
        _, tight = self.judge(powers, self.check, MARGIN)
        value = float(cost.mean() + PRICE[1] * self.judge.spacing_s * _penalty(tight).mean())
        worst = excess.amax(dim=(1, 2)) * self.judge.omega_bound / (2 * math.pi)
        return {
            "held out": value,
            "cost": float(cost.mean()),
            "mean excess": float(worst.mean()),
            "max excess": float(worst.max()),
        }

    def load(self, device: str) -> None:
        """See `TrainingRun.load`; rows are chosen on the CPU."""
        super().load(device)
        self.penalty = self.penalty.cpu()


def _penalty(excess: Tensor) -> Tensor:
    """Exact (first-order) penalty with a second-order part, shape (batch,)."""
    return (excess + excess.square() / (2.0 * DOUBLING)).sum(dim=(1, 2))
