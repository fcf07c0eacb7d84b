"""Train the paper's DED-DPC policy by AdamW on its loss, eq. (DPC_loss).

From the paper: network, loss and weights, 50 knots, AdamW at a constant learning rate of 5e-4, the 400
training instances, raw inputs. The paper leaves open

* the batch size: 8, the best of 4 to 32 on 80 of the 400 after two minutes on the other 320;
* the number of epochs: 900; the held-out loss still fell slowly at 365;
* the scaling of gradients: none, and no clipping, since AdamW's steps do not depend on their scale;
* which weights to keep: those after the last step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ded_bench.methods.dpc_paper.paper_policy import FILTERS, WINDOWS, PaperPolicy, channels, n_channels
from ded_bench.methods.trained_policy import Scope, weights_of
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.methods.training_run import TrainingRun, repeatable, tensors_on
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.surrogates.koopman import CondensedRollout, Koopman, free_response, hat_functions

LEARNING_RATE = 5e-4
BATCH, EPOCHS = 8, 900
#: Weights of the penalty terms (paper, section on the implementation).
Q_OMEGA, Q_RAMP, Q_INITIAL = 1e3, 1e2, 1e4


class PaperNetwork(nn.Module):
    """The paper's control policy: channels over the knots in, generator powers at the knots out."""

    def __init__(self, n_channels: int, p_min: Array, p_max: Array) -> None:
        super().__init__()
        sizes, layers = (n_channels, FILTERS, FILTERS, len(p_min)), list[nn.Module]()
        for i, window in enumerate(WINDOWS):
            zeros = nn.ConstantPad1d(((window - 1) // 2, window // 2), 0.0)  # a convolution keeps the length
            layers += [zeros, nn.Conv1d(sizes[i], sizes[i + 1], window), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])
        self.mean = nn.Buffer(torch.zeros(n_channels, 1))  # of inputs: raw in the paper's recipe
        self.scale = nn.Buffer(torch.ones(n_channels, 1))
        self.p_min = nn.Buffer(torch.as_tensor(p_min, dtype=torch.float32)[:, None])
        self.p_max = nn.Buffer(torch.as_tensor(p_max, dtype=torch.float32)[:, None])

    def forward(self, channels: Tensor) -> Tensor:
        """Map (batch, n_channels, n_knots) to powers, (batch, n_knots, n_gen), pu, within bounds."""
        out = self.layers((channels - self.mean) / self.scale)
        return (self.p_min + 0.5 * (1.0 + torch.tanh(out)) * (self.p_max - self.p_min)).transpose(1, 2)


class Batch(NamedTuple):
    """Instances as tensors, ready for the loss."""

    channels: Tensor  # (batch, n_channels, n_knots)
    free: Tensor  # (batch, n_gen + 1, n_points): free response, rad/s and pu
    cost_gen: Tensor  # (batch, n_gen)
    cost_slack: Tensor  # (batch,)
    p_initial: Tensor  # (batch, n_gen), pu

    @staticmethod
    def of(case: Case, model: Koopman, instances: Sequence[Instance]) -> Batch:
        """Features and free responses of instances with one time grid."""
        arrays = (
            channels(Network(case), instances, case.knot_times(instances[0].horizon_s)),
            free_response(model, model.initial(instances), np.stack([i.p_load(case) for i in instances])),
            np.stack([i.cost_gen(case) for i in instances]),
            np.array([i.cost_slack(case) for i in instances]),
            np.stack([i.p_initial(case) for i in instances]),
        )
        return Batch(*(torch.as_tensor(a.copy(), dtype=torch.float32) for a in arrays))


class PaperLoss:
    """The paper's loss on the condensed rollout of a surrogate: (ω, P_s) = free response + Γ knots."""

    def __init__(self, condensed: CondensedRollout, omega_bound: float, ramp: Array) -> None:
        """Bounds in rad/s and, for each generator, pu per step."""
        gamma = condensed.gamma.reshape(-1, condensed.gamma.shape[2])
        arrays = gamma, hat_functions(condensed.points, condensed.knots), ramp
        self.gamma, self.hats, self.ramp = (torch.as_tensor(array, dtype=torch.float32) for array in arrays)
        self.n_gen, self.omega_bound = len(condensed.gamma) - 1, omega_bound

    def __call__(self, knots: Tensor, batch: Batch) -> dict[str, Tensor]:
        """The six terms of eq. (DPC_loss) of each instance, weighted, shape (batch,) each.

        Args:
            knots: powers, (batch, n_knots, n_gen), pu.
            batch: the instances.
        """
        out = batch.free + (knots.flatten(1) @ self.gamma.T).view_as(batch.free)
        omega, p_slack = out[:, : self.n_gen], out[:, self.n_gen]
        p_gen = knots.transpose(1, 2) @ self.hats.T  # at all grid points, (batch, n_gen, n_points)
        step, ramp = p_gen.diff(dim=2), self.ramp[:, None]
        generators = (batch.cost_gen * p_gen.sum(dim=2)).sum(dim=1)
        return {
            "objective": generators + batch.cost_slack * p_slack.abs().sum(dim=1),
            "omega above": Q_OMEGA * _squared_excess(omega - self.omega_bound),
            "omega below": Q_OMEGA * _squared_excess(-omega - self.omega_bound),
            "ramp down": Q_RAMP * _squared_excess(-step - ramp),
            "ramp up": Q_RAMP * _squared_excess(step - ramp),
            "initial": Q_INITIAL * (p_gen[:, :, 0] - batch.p_initial).square().sum(dim=1),
        }


def _squared_excess(value: Tensor) -> Tensor:
    return value.relu().square().sum(dim=(1, 2))


@repeatable()
def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> PaperPolicy:
    """Train the paper's policy; see `training_record.Trainer`.

    Args:
        instances: to train on; they share one time grid.
    """
    model, first = options.find_model(case), instances[0]
    model.check_step(first)
    with tensors_on(options.device):
        condensed = CondensedRollout.make(model, first.grid, case.knot_times(first.horizon_s))
        data = Batch.of(case, model, instances)
        loss = PaperLoss(condensed, case.omega_bound(regime), case.ramp * first.dt_s)
    with torch.random.fork_rng():
        torch.manual_seed(options.seed)
        network = PaperNetwork(n_channels(case), case.p_min, case.p_max)
    run = PaperTraining(network.to(options.device), loss, data, options.seed, out)
    title = f"{PaperPolicy.method} {regime}"
    facts = run.train(options, EPOCHS, title, case.fingerprint, model.fingerprint) | {
        "instances": len(instances),
        "held_out": 0,
        "model": model.kind,
        "model_fingerprint": model.fingerprint,
    }
    policy = PaperPolicy(Scope(case, regime, first.horizon_s), weights_of(network), facts)
    policy.save(out)
    return policy


class PaperTraining(TrainingRun):
    """The paper's recipe: a constant learning rate, gradients as they are, the last weights."""

    clip_norm, average_decay, looks = math.inf, 0.0, 90

    def __init__(self, network: PaperNetwork, loss: PaperLoss, data: Batch, seed: int, out: Path) -> None:
        super().__init__(network, torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE), seed, out)
        self.judge, self.data, self.seen = loss, data, 0
        self.totals: dict[str, float] = {}  # of each term over the instances of this epoch that were seen

    def rate(self, whole: float, progress: float) -> float:
        """Constant."""
        return whole

    def batches(self) -> Sequence[Tensor]:
        """All instances, shuffled."""
        self.totals, self.seen = {}, 0
        return torch.split(torch.randperm(len(self.data.channels), generator=self.generator), BATCH)

    def loss(self, rows: Tensor, progress: float) -> Tensor:
        """The sum of the terms."""
        batch = type(self.data)(*(part[rows] for part in self.data))
        terms = {name: term.mean() for name, term in self.judge(self.network(batch.channels), batch).items()}
        for name, value in terms.items():
            self.totals[name] = self.totals.get(name, 0.0) + value.item() * len(rows)
        self.seen += len(rows)
        return torch.stack(list(terms.values())).sum()

    def look(self) -> dict[str, float]:
        """The mean of each term over the epoch, every batch as it was seen."""
        terms = {name: total / self.seen for name, total in self.totals.items()}
        return {"training": sum(terms.values())} | terms
