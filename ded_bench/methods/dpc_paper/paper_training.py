"""Train the paper's DED-DPC policy: AdamW on its loss, best weights on held-out instances kept."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm

from ded_bench.files.strict import write_atomically
from ded_bench.koopman.condensed import free_response
from ded_bench.koopman.model import Koopman
from ded_bench.methods.dpc_paper.paper_features import Features
from ded_bench.methods.dpc_paper.paper_loss import Condensed, full_precision, knot_times, loss_terms
from ded_bench.methods.dpc_paper.paper_policy import METHOD, N_KNOTS, PaperNetwork, Policy, n_channels
from ded_bench.methods.policy_file import reading_checkpoint
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.truth.network import Network

LEARNING_RATE = 5e-4
BATCH, EPOCHS, VALIDATE_EVERY = 8, 900, 10
#: What is validated and kept is an exponential average of the weights over about 2,000 steps:
#: at a constant learning rate the last iterate wanders.
AVERAGING = 0.9995
#: Fraction of the training instances that choose the best weights and are never trained on.
HELD_OUT = 0.2


@dataclass(frozen=True, eq=False)
class Batch:
    """Instances as tensors, ready for the loss."""

    channels: Tensor  # (batch, n_channels, n_knots)
    free: Tensor  # (batch, n_gen + 1, n_points)
    cost_gen: Tensor
    cost_slack: Tensor
    p_initial: Tensor

    @staticmethod
    def of(case: Case, model: Koopman, instances: Sequence[Instance], device: str) -> Batch:
        """Features and free responses of instances with one time grid."""
        network = Network(case)
        features = Features.of(network, instances, knot_times(instances[0].horizon_s, N_KNOTS))
        p_load = np.stack([i.p_load(case) for i in instances])
        free = free_response(model, model.initial(network, instances), p_load)
        arrays = (features.channels(), free, features.cost[:, 1:], features.cost[:, 0], features.p_initial)
        return Batch(*(torch.as_tensor(a.copy(), dtype=torch.float32, device=device) for a in arrays))

    def __len__(self) -> int:
        return len(self.channels)

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(
            self.channels[rows],
            self.free[rows],
            self.cost_gen[rows],
            self.cost_slack[rows],
            self.p_initial[rows],
        )


def policy_loss(
    network: PaperNetwork, condensed: Condensed, batch: Batch, omega_bound: float, ramp: float
) -> dict[str, Tensor]:
    """Mean of each term of the paper's loss over a batch."""
    knots = network(batch.channels)
    omega, p_slack = condensed.rollout(batch.free, knots)
    terms = loss_terms(
        omega,
        p_slack,
        condensed.powers(knots),
        batch.cost_gen,
        batch.cost_slack,
        batch.p_initial,
        omega_bound,
        ramp,
    )
    return {name: value.mean() for name, value in terms.items()}


@full_precision
def train(
    case: Case,
    regime: str,
    instances: Sequence[Instance],
    model: Koopman,
    out: Path,
    *,
    seed: int = 0,
    epochs: int = EPOCHS,
    seconds: float | None = None,
    device: str = "cpu",
    resume: bool = False,
) -> Policy:
    """Train the paper's policy on instances that share one time grid.

    A fifth of the instances is held out to choose the best weights. The loss history is written
    beside the policy as `<name>.history.csv`, the state to resume from as `<name>.checkpoint.pt`.

    Args:
        seconds: stop after this much training time, whatever `epochs` says.
        resume: go on from the checkpoint if there is one.
    """
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(instances), generator=generator).tolist()
    n_held = max(1, round(HELD_OUT * len(instances)))
    held_out = Batch.of(case, model, [instances[i] for i in order[:n_held]], device)
    data = Batch.of(case, model, [instances[i] for i in order[n_held:]] or list(instances), device)
    first = instances[0]
    knots = knot_times(first.horizon_s, N_KNOTS)
    condensed = Condensed.make(case, model, first.grid, knots, torch.float32).to(device)
    bound, ramp = case.omega_bound(regime), case.ramp_pu_per_s * first.dt_s

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PaperNetwork(n_channels(case), case.p_min, case.p_max).to(device)
    network.normalise(data.channels)
    optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE)
    average = get_ema_multi_avg_fn(AVERAGING)  # type: ignore[no-untyped-call]
    averaged = AveragedModel(network, multi_avg_fn=average)
    validated = cast(PaperNetwork, averaged.module)
    history: list[dict[str, float]] = []
    best, best_weights = float("inf"), network.state_dict()
    epoch, spent = 0, 0.0
    checkpoint = out.with_suffix(".checkpoint.pt")
    if resume and checkpoint.is_file():
        with reading_checkpoint(checkpoint):
            state = torch.load(checkpoint, weights_only=True, map_location=device)
            network.load_state_dict(state["network"])
            averaged.load_state_dict(state["averaged"])
            optimiser.load_state_dict(state["optimiser"])
            generator.set_state(state["generator"].cpu())
            best, best_weights = state["best"], state["best_weights"]
            epoch, spent, history = state["epoch"], state["spent"], state["history"]

    started = time.perf_counter() - spent
    with tqdm(total=epochs, initial=epoch, unit="epoch", disable=None, desc=f"{METHOD} {regime}") as bar:
        while epoch < epochs and (seconds is None or time.perf_counter() - started < seconds):
            for rows in torch.split(torch.randperm(len(data), generator=generator), BATCH):
                terms = policy_loss(network, condensed, data[rows], bound, ramp)
                optimiser.zero_grad()
                loss = torch.stack(list(terms.values())).sum()
                torch.autograd.backward(loss)
                optimiser.step()
                averaged.update_parameters(network)
            epoch += 1
            bar.update()
            if epoch % VALIDATE_EVERY and epoch < epochs:
                continue
            with torch.no_grad():
                terms = policy_loss(validated, condensed, held_out, bound, ramp)
            value = float(sum(terms.values()))
            spent = time.perf_counter() - started
            history.append(
                {"epoch": epoch, "seconds": spent, "training": loss.item(), "held out": value}
                | {name: term.item() for name, term in terms.items()}
            )
            if value < best:
                best = value
                best_weights = {name: v.clone() for name, v in validated.state_dict().items()}
            bar.set_postfix_str(f"held out {value:.2f}, best {best:.2f}")
            state = {
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimiser": optimiser.state_dict(),
                "generator": generator.get_state(),
                "best": best,
                "best_weights": best_weights,
                "epoch": epoch,
                "spent": spent,
                "history": history,
            }
            buffer = io.BytesIO()
            torch.save(state, buffer)
            write_atomically(checkpoint, buffer.getvalue())
    network.load_state_dict(best_weights)
    training = {
        "seed": seed,
        "epochs": epoch,
        "seconds": spent,
        "instances": len(data),
        "held_out": len(held_out),
        "held_out_loss": best,
        "parameters": sum(p.numel() for p in network.parameters()),
        "model": model.kind,
        "model_fingerprint": model.fingerprint,
        "torch": torch.__version__,
        "device": device,
    }
    policy = Policy(case, regime, first.horizon_s, network.cpu().eval(), training)
    policy.save(out)
    write_atomically(out.with_suffix(".history.csv"), pd.DataFrame(history).to_csv(index=False))
    return policy
