"""Train `ded-dpc` on instances drawn afresh: no solution is needed, only the condensed rollout."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ded_bench.methods.dpc.coarse_rollout import coarse_free_response, coarse_stride
from ded_bench.methods.dpc.inputs import Channels, Inputs
from ded_bench.methods.dpc.loss import Objective
from ded_bench.methods.dpc.policy import METHOD, DispatchPolicy
from ded_bench.methods.dpc.policy_network import DILATIONS, STAGES, WIDTH, StagedNetwork
from ded_bench.methods.dpc.response import Response
from ded_bench.methods.policy_file import Scope
from ded_bench.methods.training_device import reading_checkpoint, repeatable, save_checkpoint
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file, write_history
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instances
from ded_bench.surrogates.condensed import CondensedRollout
from ded_bench.surrogates.koopman import Koopman

#: Fresh instances, epochs over them, batch size.
FRESH, EPOCHS, BATCH = 64_000, 32, 128
LEARNING_RATE, WEIGHT_DECAY, CLIP_NORM = 6e-3, 1e-4, 1.0
#: Fractions of the training: warm-up of the learning rate, then a cosine down to `LAST` of it.
WARM_UP, LAST = 0.02, 1e-3
AVERAGE = 0.998  # of the weights, exponentially
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
#: Fraction of given instances that choose the best weights, if no fresh ones are drawn.
HELD_OUT = 0.2
#: A training that is to end soon draws no more fresh instances than so many per second.
FRESH_PER_SECOND = 200
REPORTS = 40
PROGRESS = ("epoch", "step", "spent", "busy", "best", "best_weights", "history", "penalty")


@dataclass(frozen=True)
class Variant:
    """What the ablation study changes of network and training, one at a time."""

    stages: int = STAGES
    width: int = WIDTH
    dilations: tuple[int, ...] = DILATIONS
    batch: int = BATCH
    rate: str = "cosine"  # or "constant": of the learning rate, after its warm-up
    prior: bool = True  # corrections of the static dispatch, or of the middle of the generators' range
    blind: tuple[str, ...] = ()  # groups of channels that the network does not see
    normalise: bool = True


@dataclass(frozen=True, eq=False)
class Pool:
    """Instances as tensors, ready for the loss."""

    start: Tensor  # (batch, n_knots, n_gen), pu
    free_response: Tensor  # of the linearisation, at the knots, (batch, n_knots, n_outputs)
    sequence: Tensor  # (batch, n_knots, n_sequence)
    constants: Tensor  # (batch, n_constants)
    cost: Tensor  # (batch, 1 + n_gen)
    scale: Tensor  # (batch,): what costs are relative to
    coarse_free_response: Tensor  # of the model, (batch, n_gen + 1, n_coarse)

    @staticmethod
    def of(channels: Channels, inputs: Inputs, free: np.ndarray, n_points: int) -> Pool:
        """Convert channels and free responses to float32."""
        scale = np.maximum(channels.static_cost(inputs), SMALLEST_COST) * n_points
        seen = channels.start, channels.free_response, channels.sequence, channels.constants
        arrays = (*seen, inputs.cost, scale, free)
        return Pool(*(torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32) for a in arrays))

    def to(self, device: str) -> Pool:
        """The same on another device."""
        return Pool(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, rows: Tensor) -> Pool:
        return Pool(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Loss:
    """Relative cost and frequency excess of a network's schedules."""

    objective: Objective
    omega_bound: float  # rad/s
    spacing_s: float  # of the coarse points

    def powers(self, network: StagedNetwork, pool: Pool) -> Tensor:
        """Schedules at the knots, (batch, n_knots, n_gen), pu: what `DispatchPolicy.powers` computes."""
        powers: Tensor = network(pool.start, pool.free_response, pool.sequence, pool.constants)
        return powers

    def __call__(self, powers: Tensor, pool: Pool, margin: float = 0.0) -> tuple[Tensor, Tensor]:
        """Cost relative to the scale, (batch,), and relative excess of |ω|, (batch, n_gen, n_coarse)."""
        omega, p_slack = self.objective.rollout(pool.coarse_free_response, powers)
        cost = self.objective.cost(powers, p_slack, pool.cost) / pool.scale
        return cost, (omega.abs() / self.omega_bound - (1.0 - margin)).relu()


@repeatable()
def train(
    case: Case,
    regime: str,
    instances: Sequence[Instance],
    model: Koopman,
    out: Path,
    options: TrainingOptions,
    /,
    *,
    epochs: int = EPOCHS,
    fresh: int = FRESH,
    **variant: Any,
) -> DispatchPolicy:
    """Train a policy; see `training_record.Trainer`.

    With fresh instances, those given choose the best weights and are never trained on.

    Args:
        instances: share one time grid and horizon.
        options: the schedule of the learning rate is fitted to its seconds, if given.
        fresh: how many instances to draw; 0 trains on four fifths of those given.
        variant: fields of `Variant`.
    """
    chosen, seed, device = Variant(**variant), options.seed, options.device
    first = instances[0]
    scope = Scope(case, regime, first.horizon_s)
    response = Response.make(case, case.knot_times(first.horizon_s))
    stride = coarse_stride(first.dt_s, first.steps)
    generator = torch.Generator().manual_seed(seed)
    parts = _split(case, instances, fresh, options, generator)
    inputs = [Inputs.of(case, part) for part in parts]
    channels = [Channels.of(case, part, response, chosen.prior) for part in inputs]
    free = [coarse_free_response(Network(case), model, part, first.grid, stride) for part in inputs]
    data, check = (
        Pool.of(c, i, f, len(first.grid)).to(device) for c, i, f in zip(channels, inputs, free, strict=True)
    )
    condensed = CondensedRollout.make(case, model, first.grid, response.knots, stride)
    loss = Loss(Objective.make(condensed).to(device), case.omega_bound(regime), stride * first.dt_s)
    network = _untrained(case, response, channels[0], chosen, seed).to(device)
    run = _Run(network, loss, generator, chosen, checkpoint_file(out), len(data))
    if options.resume and run.checkpoint.is_file():
        run.load(device)
    run.go(data, check, epochs, options.seconds, f"{METHOD} {regime}")
    network.load_state_dict(run.best_weights)
    training = run.facts() | {
        "seed": seed,
        "instances": len(data),
        "fresh": bool(fresh),
        "held_out": len(check),
        "prior": chosen.prior,
        "variant": {k: v for k, v in asdict(chosen).items() if v != getattr(Variant(), k)},
        "model": model.kind,
        "model_fingerprint": model.fingerprint,
        "torch": torch.__version__,
        "code": options.code,
        "device": device,
    }
    policy = DispatchPolicy.of(scope, network, training)
    policy.save(out)
    write_history(out, run.history)
    return policy


def _untrained(
    case: Case, response: Response, channels: Channels, chosen: Variant, seed: int
) -> StagedNetwork:
    """The network before the first step; `channels` give the scale of its inputs."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = StagedNetwork(case, response, chosen.stages, chosen.width, chosen.dilations)
    if chosen.normalise:
        network.normalise(channels)
    network.hide(chosen.blind)
    return network


def _split(
    case: Case,
    instances: Sequence[Instance],
    fresh: int,
    options: TrainingOptions,
    generator: torch.Generator,
) -> tuple[list[Instance], list[Instance]]:
    """Instances to train on, and those that choose the best weights."""
    if fresh:
        if options.seconds is not None:
            fresh = min(fresh, math.ceil(FRESH_PER_SECOND * options.seconds))
        drawn = sample_instances(case, POLICY_SEED + options.seed, fresh, servable=servable)
        return list(drawn), list(instances)
    order = torch.randperm(len(instances), generator=generator).tolist()
    n_held_out = max(1, round(HELD_OUT * len(instances)))
    held_out = [instances[i] for i in order[:n_held_out]]
    return [instances[i] for i in order[n_held_out:]] or held_out, held_out


class _Run:
    """The state of one training: network, average of its weights, optimiser, progress."""

    def __init__(
        self,
        network: StagedNetwork,
        loss: Loss,
        generator: torch.Generator,
        variant: Variant,
        checkpoint: Path,
        n_data: int,
    ) -> None:
        self.network, self.loss, self.generator, self.checkpoint = network, loss, generator, checkpoint
        self.variant = variant
        self.average = copy.deepcopy(network)
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, betas=(0.9, 0.99), fused=True
        )
        self.epoch, self.step, self.spent, self.busy = 0, 0, 0.0, 0.0
        self.best, self.best_weights = math.inf, copy.deepcopy(network.state_dict())
        self.history: list[dict[str, float]] = []
        self.penalty = torch.zeros(n_data)  # of each instance when it was last seen

    def go(self, data: Pool, check: Pool, epochs: int, seconds: float | None, title: str) -> None:
        """Train until the epochs are done or the time is over."""
        started, busy = time.perf_counter() - self.spent, time.process_time() - self.busy
        progress = self.epoch / epochs
        with tqdm(total=epochs, initial=self.epoch, unit="epoch", disable=None, desc=title) as bar:
            while progress < 1.0:
                batches = torch.split(self._order(), self.variant.batch)
                for i, rows in enumerate(batches, start=1):
                    self._update(data, rows, progress)
                    self.spent, self.busy = time.perf_counter() - started, time.process_time() - busy
                    progress = (self.epoch + i / len(batches)) / epochs
                    if seconds is not None and (progress := max(progress, self.spent / seconds)) >= 1.0:
                        break
                self.epoch += 1
                bar.update()
                if progress >= 1.0 or self.epoch % max(1, epochs // REPORTS) == 0:
                    row = self._validate(check)
                    bar.set_postfix_str(f"cost {row['cost']:.5f}, excess {row['max excess']:.4f}")
                    self._save()

    def facts(self) -> dict[str, Any]:
        """What the policy's file tells of it."""
        return {
            "epochs": self.epoch,
            "steps": self.step,
            "seconds": self.spent,
            "cpu_seconds": self.busy,
            "held_out_loss": self.best,
            "parameters": sum(p.numel() for p in self.network.parameters()),
        }

    def _order(self) -> Tensor:
        """Rows of the next epoch: all, the hard ones repeatedly, shuffled."""
        worst = torch.topk(self.penalty, round(HARD * len(self.penalty))).indices
        worst = worst[self.penalty[worst] > 0]
        rows = torch.cat([torch.arange(len(self.penalty)), worst.repeat(REPEATS)])
        return rows[torch.randperm(len(rows), generator=self.generator)]

    def _update(self, data: Pool, rows: Tensor, progress: float) -> None:
        falling = 0.5 * (1.0 + math.cos(math.pi * progress)) if self.variant.rate == "cosine" else 1.0
        rate = LAST + (1.0 - LAST) * falling
        for group in self.optimiser.param_groups:
            group["lr"] = LEARNING_RATE * rate * min(1.0, 0.05 + progress / WARM_UP)
        batch = data[rows.to(data.start.device)]
        cost, excess = self.loss(self.loss.powers(self.network, batch), batch, MARGIN)
        penalty = _penalty(excess)
        price = PRICE[0] * (PRICE[1] / PRICE[0]) ** progress * self.loss.spacing_s
        total = cost.mean() + price * penalty.mean()
        self.penalty[rows] = penalty.detach().cpu()
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(total)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP_NORM, foreach=True)
        self.optimiser.step()
        self.step += 1
        keep = min(AVERAGE, 1.0 - 1.0 / (1.0 + self.step / 10.0))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1.0 - keep)

    def _validate(self, check: Pool) -> dict[str, float]:
        with torch.no_grad():
            cost, excess = self.loss(self.loss.powers(self.average, check), check)
            _, tight = self.loss(self.loss.powers(self.average, check), check, MARGIN)
        value = float(cost.mean() + PRICE[1] * self.loss.spacing_s * _penalty(tight).mean())
        worst = excess.amax(dim=(1, 2)) * self.loss.omega_bound / (2 * math.pi)
        row = {
            "epoch": self.epoch,
            "step": self.step,
            "seconds": self.spent,
            "held out": value,
            "cost": float(cost.mean()),
            "mean excess": float(worst.mean()),  # Hz, as the next
            "max excess": float(worst.max()),
        }
        self.history.append(row)
        if value < self.best:
            self.best, self.best_weights = value, copy.deepcopy(self.average.state_dict())
        return row

    def _save(self) -> None:
        state: dict[str, Any] = {name: getattr(self, name) for name in PROGRESS}
        state |= {name: getattr(self, name).state_dict() for name in ("network", "average", "optimiser")}
        save_checkpoint(self.checkpoint, state | {"generator": self.generator.get_state()})

    def load(self, device: str) -> None:
        """Go on from the checkpoint.

        Raises:
            InputError: it is no checkpoint, or one of another training.
        """
        with reading_checkpoint(self.checkpoint, device) as state:
            for name in ("network", "average", "optimiser"):
                getattr(self, name).load_state_dict(state[name])
            for name in PROGRESS:
                setattr(self, name, state[name])
            self.penalty = self.penalty.cpu()
            self.generator.set_state(state["generator"].cpu())


def _penalty(excess: Tensor) -> Tensor:
    """Exact (first-order) penalty with a second-order part, shape (batch,)."""
    return (excess + excess.square() / (2.0 * DOUBLING)).sum(dim=(1, 2))
