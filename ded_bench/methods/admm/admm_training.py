"""Train the shared policy on problems drawn afresh for every step; no solution is needed."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ded_bench.files.arrays import read_arrays
from ded_bench.files.errors import InputError
from ded_bench.methods.admm.admm_inference import weight_shapes
from ded_bench.methods.admm.admm_iterations import UnrolledIterations
from ded_bench.methods.admm.admm_loss import MARGIN, ScheduleLoss
from ded_bench.methods.admm.admm_margin import with_margin
from ded_bench.methods.admm.admm_policy import METHOD, SharedPolicy
from ded_bench.methods.admm.drawn_problems import Problems, draw
from ded_bench.methods.admm.grid_response import GridResponse
from ded_bench.methods.admm.iteration_records import PRICE
from ded_bench.methods.admm.path_model import Outset, PathModel
from ded_bench.methods.policy_file import Scope, Weights, checked_weights, weights_fingerprint
from ded_bench.methods.training_device import reading_checkpoint, repeatable, save_checkpoint
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file, write_history
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED
from ded_bench.surrogates.koopman import Koopman

#: Iterations of an answer: the fewest, and times generators on small grids, where they take less time. Where
#: the bound on |ω| is loose, schedules are shaped by ramps, and a few iterations go almost as far.
TIGHT, LOOSE = (14, 60), (3, 30)
#: A bound is loose if a generator that ramps alone, at its limit, turns at less than this part of it.
RAMPING = 0.1
#: Steps of an epoch, epochs.
STEPS, EPOCHS = 100, 8
#: Problems of a step: so many that generators times knots of all are near the first number.
ROWS, SMALLEST_BATCH = 4000, 8
LEARNING_RATE, CLIP_NORM = 0.1, 1.0
#: Fractions of the training: warm-up of the learning rate, then a cosine down to `LAST` of it.
WARM_UP, LAST = 0.02, 1e-3
AVERAGE = 0.998  # of the weights, exponentially
#: Penalty, as a part of an instance's cost, of which half counts: a few instances have no feasible schedule,
#: and would else be all that is learned from.
HOPELESS = 0.1
#: Most instances on which weights are compared.
HELD_OUT = 100
PROGRESS = ("epoch", "step", "spent", "busy", "best", "best_weights", "history")


@dataclass(frozen=True)
class Variant:
    """What a training may choose."""

    iterations: int | None = None  # see `iterations_of`
    rate: float = LEARNING_RATE
    price: float = PRICE  # of the penalty


def iterations_of(model: PathModel) -> int:
    """Iterations of an answer, by the size of a case and how tight its bound is."""
    rates = model.ramp / (np.diag(model.response.stiffness) * model.spacing)
    fewest, rounds = LOOSE if np.median(rates) < RAMPING * model.bound else TIGHT
    return max(fewest, rounds // len(rates))


def batch_of(case: Case) -> int:
    """Problems of a step, by the size of a case."""
    return max(SMALLEST_BATCH, ROWS // (len(case.generators) * case.n_knots))


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
    **variant: Any,
) -> SharedPolicy:
    """Train a policy; see `training_record.Trainer`. The grid itself is the model: `model` is not used.

    Args:
        instances: choose the best weights, and are never trained on.
        variant: fields of `Variant`.
    """
    chosen = Variant(**variant)
    del model
    if options.device != "cpu":
        raise InputError("--device", options.device, f"{METHOD} is trained on the CPU")
    horizon = instances[0].horizon_s
    response = GridResponse.make(case, case.knot_times(horizon))
    path_model = PathModel(case, case.omega_bound(regime), response)
    unrolled = UnrolledIterations(path_model, chosen.iterations or iterations_of(path_model))
    start = read_start(options.start) if options.start else None
    if start is not None:
        unrolled.load_state_dict({name: torch.as_tensor(value) for name, value in start.items()})
    check = path_model.outset(Problems.of(case, instances[:HELD_OUT], response.fine))
    run = _Run(unrolled, options.seed, chosen, batch_of(case), checkpoint_file(out))
    if options.resume and run.checkpoint.is_file():
        run.load()
    with np.errstate(over="ignore", invalid="ignore"):  # a draw may swing up without end
        run.go(check, epochs, options.seconds, f"{METHOD} {regime}")
    unrolled.load_state_dict(run.best_weights)
    training = {
        "seed": options.seed,
        "epochs": run.epoch,
        "steps": run.step,
        "batch": run.batch,
        "seconds": run.spent,
        "cpu_seconds": run.busy,
        "instances": run.step * run.batch,
        "held_out": len(check.served),
        "held_out_loss": run.best,
        "parameters": sum(p.numel() for p in unrolled.parameters()),
        "price": chosen.price,
        "start": weights_fingerprint(start) if start is not None else "",
        "torch": torch.__version__,
        "code": options.code,
        "device": options.device,
    }
    policy = with_margin(SharedPolicy.of(Scope(case, regime, horizon), unrolled, training), instances)
    policy.save(out)
    write_history(out, run.history)
    return policy


def read_start(path: Path) -> Weights:
    """Weights of a policy of whatever grid and regime, to start from.

    Raises:
        InputError: the file is wrong, or a policy of another method.
    """
    arrays, header = read_arrays(path)
    if header.get("method") != METHOD:
        raise InputError(path, "method", f"is no {METHOD} policy")
    return checked_weights(arrays, weight_shapes(), path)


class _Run:
    """The state of one training: iterations, average of their weights, optimiser, progress."""

    def __init__(
        self, unrolled: UnrolledIterations, seed: int, chosen: Variant, batch: int, checkpoint: Path
    ) -> None:
        self.unrolled, self.seed, self.batch, self.checkpoint = unrolled, seed, batch, checkpoint
        self.rate, self.price = chosen.rate, chosen.price
        self.loss = ScheduleLoss(unrolled.model)
        self.average = copy.deepcopy(unrolled)
        self.optimiser = torch.optim.Adam(unrolled.parameters(), lr=chosen.rate, betas=(0.9, 0.99))
        self.epoch, self.step, self.spent, self.busy = 0, 0, 0.0, 0.0
        self.best, self.best_weights = math.inf, copy.deepcopy(unrolled.state_dict())
        self.history: list[dict[str, float]] = []

    def go(self, check: Outset, epochs: int, seconds: float | None, title: str) -> None:
        """Train until the epochs are done or the time is over."""
        started, busy = time.perf_counter() - self.spent, time.process_time() - self.busy
        progress = self.epoch / epochs
        with tqdm(total=epochs, initial=self.epoch, unit="epoch", disable=None, desc=title) as bar:
            while progress < 1.0:
                for i in range(1, STEPS + 1):
                    self._update(progress)
                    self.spent, self.busy = time.perf_counter() - started, time.process_time() - busy
                    progress = (self.epoch + i / STEPS) / epochs
                    if seconds is not None and (progress := max(progress, self.spent / seconds)) >= 1.0:
                        break
                self.epoch += 1
                bar.update()
                row = self._validate(check)
                bar.set_postfix_str(f"cost {row['cost']:.5f}, excess {row['max excess']:.1e}")
                self._save()

    def _update(self, progress: float) -> None:
        falling = LAST + (1.0 - LAST) * 0.5 * (1.0 + math.cos(math.pi * progress))
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate * falling * min(1.0, 0.05 + progress / WARM_UP)
        model = self.unrolled.model
        # a generator of its own for every step: a training that goes on draws what it would have drawn
        generator = np.random.default_rng(np.random.SeedSequence([POLICY_SEED + self.seed, self.step]))
        outset = model.outset(draw(model.case, model.bound, model.response.fine, self.batch, generator))
        judged = self.loss(outset, self.unrolled(outset), MARGIN)
        self.step += 1
        used = torch.as_tensor(outset.served)
        if not used.any():
            return
        self.optimiser.zero_grad(set_to_none=True)
        penalty = self.price * judged.penalty
        torch.autograd.backward((judged.cost + penalty / (1.0 + penalty / HOPELESS))[used].mean())
        norm = torch.nn.utils.clip_grad_norm_(self.unrolled.parameters(), CLIP_NORM)
        if not torch.isfinite(norm):
            return
        self.optimiser.step()
        keep = min(AVERAGE, 1.0 - 1.0 / (1.0 + self.step / 10.0))
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.average.parameters()), list(self.unrolled.parameters()), 1.0 - keep
            )

    def _validate(self, check: Outset) -> dict[str, float]:
        with torch.no_grad():
            outcome = self.average(check)
            tight, own = (self.loss(check, outcome, margin) for margin in (MARGIN, 0.0))
        value = float((tight.cost + self.price * tight.penalty).mean())
        hertz = own.excess * self.loss.model.bound / (2 * math.pi)
        row = {
            "epoch": self.epoch,
            "step": self.step,
            "seconds": self.spent,
            "held out": value,
            "cost": float(own.cost.mean()),
            "mean excess": float(hertz.mean()),  # Hz, as the next
            "max excess": float(hertz.max()),
        }
        self.history.append(row)
        if value < self.best:
            self.best, self.best_weights = value, copy.deepcopy(self.average.state_dict())
        return row

    def _save(self) -> None:
        state: dict[str, Any] = {name: getattr(self, name) for name in PROGRESS}
        state |= {name: getattr(self, name).state_dict() for name in ("unrolled", "average", "optimiser")}
        save_checkpoint(self.checkpoint, state)

    def load(self) -> None:
        """Go on from the checkpoint.

        Raises:
            InputError: it is no checkpoint, or one of another training.
        """
        with reading_checkpoint(self.checkpoint, "cpu") as state:
            for name in ("unrolled", "average", "optimiser"):
                getattr(self, name).load_state_dict(state[name])
            for name in PROGRESS:
                setattr(self, name, state[name])
