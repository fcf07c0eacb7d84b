"""Train the paper's DED-DPC policy by AdamW on its loss, eq. (DPC_loss).

From the paper: network, loss and weights, 50 knots, AdamW at a constant learning rate of 5e-4, the 400
training instances, raw inputs. The paper leaves open

* the batch size: 8. In two minutes on 320 of the 400, in TO, batches of 8, 16 and 32 came to 6984, 7000 and
  6999 on the other 80; batches of 4 learn little more in an epoch, which takes twice as long;
* the number of epochs: 900, some six minutes of one core; the held-out loss still fell slowly at 365;
* the scaling of gradients: none, and no clipping, since AdamW's steps do not depend on their scale;
* which weights to keep: those after the last step.

What a `Recipe` adds beyond that is off by default.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm

from ded_bench.methods.dpc_paper.paper_features import channels, n_channels
from ded_bench.methods.dpc_paper.paper_loss import Condensed, loss_terms
from ded_bench.methods.dpc_paper.paper_network import PaperNetwork
from ded_bench.methods.dpc_paper.paper_policy import METHOD, Policy
from ded_bench.methods.policy_file import Scope, weights_of
from ded_bench.methods.training_device import reading_checkpoint, repeatable, save_checkpoint
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file, write_history
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.surrogates.condensed import free_response
from ded_bench.surrogates.koopman import Koopman

LEARNING_RATE = 5e-4
BATCH, EPOCHS = 8, 900
#: Epochs between two rows of the history.
REPORT_EVERY = 10
PROGRESS = ("epoch", "spent", "history", "lowest", "kept")


@dataclass(frozen=True)
class Recipe:
    """How the policy is trained; what the paper does not do is off."""

    epochs: int = EPOCHS
    batch: int = BATCH
    normalise: bool = False  # inputs to mean 0 and deviation 1
    averaging: float = 0.0  # decay per step of an exponential average of the weights; 0: the last weights
    held_out: float = 0.0  # fraction of the instances that choose the best weights; 0: the last weights


@dataclass(frozen=True, eq=False)
class Batch:
    """Instances as tensors, ready for the loss."""

    channels: Tensor  # (batch, n_channels, n_knots)
    free: Tensor  # (batch, n_gen + 1, n_points): free response, rad/s and pu
    cost_gen: Tensor  # (batch, n_gen)
    cost_slack: Tensor  # (batch,)
    p_initial: Tensor  # (batch, n_gen), pu

    @staticmethod
    def of(case: Case, model: Koopman, instances: Sequence[Instance], device: str) -> Batch:
        """Features and free responses of instances with one time grid."""
        network = Network(case)
        arrays = (
            channels(network, instances, case.knot_times(instances[0].horizon_s)),
            free_response(
                model, model.initial(network, instances), np.stack([i.p_load(case) for i in instances])
            ),
            np.stack([i.cost_gen(case) for i in instances]),
            np.array([i.cost_slack(case) for i in instances]),
            np.stack([i.p_initial(case) for i in instances]),
        )
        return Batch(*(torch.as_tensor(a.copy(), dtype=torch.float32, device=device) for a in arrays))

    def __len__(self) -> int:
        return len(self.channels)

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


@dataclass(frozen=True, eq=False)
class Loss:
    """The paper's loss of a network over a batch."""

    condensed: Condensed
    omega_bound: float  # rad/s
    ramp: Tensor  # (n_gen,), pu per step

    def __call__(self, network: PaperNetwork, batch: Batch) -> dict[str, Tensor]:
        """Mean of each term over the batch."""
        knots = network(batch.channels)
        omega, p_slack = self.condensed.rollout(batch.free, knots)
        powers, costs = self.condensed.powers(knots), (batch.cost_gen, batch.cost_slack)
        terms = loss_terms(omega, p_slack, powers, *costs, batch.p_initial, self.omega_bound, self.ramp)
        return {name: value.mean() for name, value in terms.items()}


@repeatable()
def train(
    case: Case,
    regime: str,
    instances: Sequence[Instance],
    model: Koopman,
    out: Path,
    options: TrainingOptions,
    /,
    **setting: Any,
) -> Policy:
    """Train the paper's policy; see `training_record.Trainer`.

    Args:
        instances: share one time grid.
        setting: fields of `Recipe`.
    """
    recipe, first = Recipe(**setting), instances[0]
    generator = torch.Generator().manual_seed(options.seed)
    seen, checked = _split(instances, recipe.held_out, generator)
    data = Batch.of(case, model, seen, options.device)
    held_out = Batch.of(case, model, checked, options.device) if checked else None
    condensed = Condensed.make(case, model, first.grid, case.knot_times(first.horizon_s), torch.float32).to(
        options.device
    )
    ramp = torch.as_tensor(case.ramp * first.dt_s, dtype=torch.float32, device=options.device)
    loss = Loss(condensed, case.omega_bound(regime), ramp)
    with torch.random.fork_rng():
        torch.manual_seed(options.seed)
        network = PaperNetwork(n_channels(case), case.p_min, case.p_max).to(options.device)
    if recipe.normalise:
        network.normalise(data.channels)
    run = _Run(network, loss, generator, recipe, checkpoint_file(out))
    if options.resume and run.checkpoint.is_file():
        run.load(options.device)
    run.go(data, held_out, options.seconds, f"{METHOD} {regime}")
    network.load_state_dict(run.kept)
    training = {
        "seed": options.seed,
        "epochs": run.epoch,
        "seconds": run.spent,
        "instances": len(data),
        "held_out": 0 if held_out is None else len(held_out),
        "parameters": sum(p.numel() for p in network.parameters()),
        "recipe": dataclasses.asdict(recipe),
        "model": model.kind,
        "model_fingerprint": model.fingerprint,
        "torch": torch.__version__,
        "code": options.code,
        "device": options.device,
    }
    training["training_loss" if held_out is None else "held_out_loss"] = run.lowest
    policy = Policy(Scope(case, regime, first.horizon_s), weights_of(network), training)
    policy.save(out)
    write_history(out, run.history)
    return policy


def _split(
    instances: Sequence[Instance], fraction: float, generator: torch.Generator
) -> tuple[list[Instance], list[Instance]]:
    """Instances to train on, and those held out."""
    if not fraction:
        return list(instances), []
    order = torch.randperm(len(instances), generator=generator).tolist()
    n_held = max(1, round(fraction * len(instances)))
    held_out = [instances[i] for i in order[:n_held]]
    return [instances[i] for i in order[n_held:]] or held_out, held_out


class _Run:
    """The state of one training: network, average of its weights, optimiser, progress."""

    def __init__(
        self, network: PaperNetwork, loss: Loss, generator: torch.Generator, recipe: Recipe, checkpoint: Path
    ) -> None:
        self.network, self.loss, self.generator = network, loss, generator
        self.recipe, self.checkpoint = recipe, checkpoint
        self.optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE)
        average = get_ema_multi_avg_fn(recipe.averaging)  # type: ignore[no-untyped-call]
        self.averaged = AveragedModel(network, multi_avg_fn=average)  # the network itself, if the decay is 0
        self.epoch, self.spent = 0, 0.0
        self.history: list[dict[str, float]] = []
        self.lowest, self.kept = float("inf"), network.state_dict()  # decisive loss, and weights to keep

    def go(self, data: Batch, held_out: Batch | None, seconds: float | None, title: str) -> None:
        """Train until the epochs are done or the time is over; one epoch at least."""
        started, epochs = time.perf_counter() - self.spent, self.recipe.epochs
        with tqdm(total=epochs, initial=self.epoch, unit="epoch", disable=None, desc=title) as bar:
            while self.epoch < epochs:
                terms = self._train_epoch(data)
                self.epoch += 1
                self.spent = time.perf_counter() - started
                bar.update()
                over = seconds is not None and self.spent >= seconds
                if over or self.epoch % REPORT_EVERY == 0 or self.epoch == epochs:
                    bar.set_postfix_str(f"loss {self._report(terms, held_out):.2f}")
                    self._save()
                if over:
                    break

    def _train_epoch(self, data: Batch) -> dict[str, float]:
        """One pass over the data; returns the mean of each term, every batch as it was seen."""
        total: dict[str, float] = {}
        for rows in torch.split(torch.randperm(len(data), generator=self.generator), self.recipe.batch):
            terms = self.loss(self.network, data[rows])
            self.optimiser.zero_grad()
            torch.autograd.backward(torch.stack(list(terms.values())).sum())
            self.optimiser.step()
            self.averaged.update_parameters(self.network)
            for name, value in terms.items():
                total[name] = total.get(name, 0.0) + value.item() * len(rows) / len(data)
        return total

    def _report(self, terms: dict[str, float], held_out: Batch | None) -> float:
        """Add a row to the history and choose the weights to keep; returns the loss that decides."""
        row = {"epoch": self.epoch, "seconds": self.spent, "training": sum(terms.values())}
        network = cast(PaperNetwork, self.averaged.module)
        if held_out is not None:
            with torch.no_grad():
                terms = {name: term.item() for name, term in self.loss(network, held_out).items()}
            row["held out"] = sum(terms.values())
        self.history.append(row | terms)
        decisive = row["held out" if held_out is not None else "training"]
        if held_out is None or decisive < self.lowest:
            self.lowest = decisive
            self.kept = {name: value.clone() for name, value in network.state_dict().items()}
        return decisive

    def _save(self) -> None:
        state: dict[str, Any] = {name: getattr(self, name) for name in PROGRESS}
        parts = (("network", self.network), ("averaged", self.averaged), ("optimiser", self.optimiser))
        state |= {name: part.state_dict() for name, part in parts}
        save_checkpoint(self.checkpoint, state | {"generator": self.generator.get_state()})

    def load(self, device: str) -> None:
        """Go on from the checkpoint.

        Raises:
            InputError: it is no checkpoint, or one of another training.
        """
        with reading_checkpoint(self.checkpoint, device) as state:
            self.network.load_state_dict(state["network"])
            self.averaged.load_state_dict(state["averaged"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.generator.set_state(state["generator"].cpu())
            for name in PROGRESS:
                setattr(self, name, state[name])
