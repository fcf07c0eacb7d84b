"""What every training in torch shares: the loop of steps, looks at the loss and checkpoints; the follower."""

from __future__ import annotations

import abc
import contextlib
import copy
import io
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file, write_history

#: Fractions of a training: warm-up of the learning rate, then a cosine down to `LAST` of it.
WARM_UP, LAST = 0.02, 1e-3


class TrainingRun(abc.ABC):
    """The state of one training: network, moving average of its weights, optimiser, progress.

    A method says what an epoch is made of, the loss of a step, and how good the average is.
    """

    #: What a checkpoint holds beside the states of network, average, optimiser and generator.
    progress: tuple[str, ...] = ("of", "epoch", "step", "spent", "busy", "best", "best_weights", "history")
    clip_norm, average_decay = 1.0, 0.998  # of gradients; of the weights, exponentially
    looks = 40  # at the loss, at most

    def __init__(self, network: nn.Module, optimiser: torch.optim.Optimizer, seed: int, out: Path) -> None:
        self.network, self.optimiser, self.generator = network, optimiser, torch.Generator().manual_seed(seed)
        self.rates = [float(group["lr"]) for group in optimiser.param_groups]
        self.of, self.out, self.average = ["", seed], out, copy.deepcopy(network)
        self.epoch, self.step, self.spent, self.busy = 0, 0, 0.0, 0.0
        self.best, self.best_weights = math.inf, copy.deepcopy(network.state_dict())
        self.history: list[dict[str, float]] = []

    @abc.abstractmethod
    def batches(self) -> Sequence[Any]:
        """What the steps of the next epoch are taken on."""

    @abc.abstractmethod
    def loss(self, batch: Any, progress: float) -> Tensor | None:
        """The loss of a step, a number; None if there is nothing to learn from. `progress` goes to 1."""

    @abc.abstractmethod
    def look(self) -> dict[str, float]:
        """How good `average` is: columns of the history, with `held out`, or `training` to keep the last."""

    def rate(self, whole: float, progress: float) -> float:
        """The learning rate, from the optimiser's own."""
        falling = LAST + (1.0 - LAST) * 0.5 * (1.0 + math.cos(math.pi * progress))
        return whole * falling * min(1.0, 0.05 + progress / WARM_UP)

    def train(self, options: TrainingOptions, epochs: int, title: str, *made_of: str) -> dict[str, Any]:
        """Train, from the checkpoint if asked; the network then has the weights to keep.

        Args:
            options: of the training.
            epochs: how many, unless the options say so.
            title: of the progress bar.
            made_of: fingerprints of the case and of what else a checkpoint has to be of.

        Returns:
            Facts for the policy's file.

        Raises:
            InputError: the checkpoint is none, or one of another training.
        """
        self.of = [title, options.seed, *made_of]
        if options.resume and checkpoint_file(self.out).is_file():
            self.load()
        epochs, seconds = options.epochs or epochs, options.seconds
        started, busy = time.perf_counter() - self.spent, time.process_time() - self.busy
        progress = max(self.epoch / epochs, 0.0 if seconds is None else self.spent / seconds)
        with tqdm(total=epochs, initial=self.epoch, unit="epoch", disable=None, desc=title) as bar:
            while progress < 1.0:
                batches = self.batches()
                for i, batch in enumerate(batches, start=1):
                    self._take_step(batch, progress)
                    self.spent, self.busy = time.perf_counter() - started, time.process_time() - busy
                    progress = (self.epoch + i / len(batches)) / epochs
                    if seconds is not None and (progress := max(progress, self.spent / seconds)) >= 1.0:
                        break
                self.epoch += 1
                bar.update()
                if progress >= 1.0 or self.epoch % max(1, epochs // self.looks) == 0:
                    bar.set_postfix_str(f"loss {self._look():.6g}")
                    self.save()
        self.network.load_state_dict(self.best_weights)
        write_history(self.out, self.history)
        return options.facts() | {
            "epochs": self.epoch,
            "steps": self.step,
            "seconds": self.spent,
            "cpu_seconds": self.busy,
            "held_out_loss" if "held out" in self.history[-1] else "training_loss": self.best,
            "parameters": sum(p.numel() for p in self.network.parameters()),
            "torch": torch.__version__,
        }

    def _take_step(self, batch: Any, progress: float) -> None:
        for group, whole in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = self.rate(whole, progress)
        loss = self.loss(batch, progress)
        self.step += 1
        if loss is None:
            return
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.clip_norm, foreach=True)
        if not torch.isfinite(norm):
            return
        self.optimiser.step()
        keep = min(self.average_decay, 1.0 - 1.0 / (1.0 + self.step / 10.0))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1.0 - keep)

    def _look(self) -> float:
        with torch.no_grad():
            row = {"epoch": self.epoch, "step": self.step, "seconds": self.spent} | self.look()
        self.history.append(row)
        found = row.get("held out", row.get("training", math.nan))
        if "held out" not in row or found < self.best:
            self.best, self.best_weights = found, copy.deepcopy(self.average.state_dict())
        return found

    def save(self) -> None:
        """Write the checkpoint."""
        state: dict[str, Any] = {name: getattr(self, name) for name in self.progress}
        state |= {name: getattr(self, name).state_dict() for name in ("network", "average", "optimiser")}
        buffer = io.BytesIO()
        torch.save(state | {"generator": self.generator.get_state()}, buffer)
        write_atomically(checkpoint_file(self.out), buffer.getvalue())

    def load(self) -> None:
        """Go on from the checkpoint, which is read without trust.

        Raises:
            InputError: it is no checkpoint, or one of another training.
        """
        path = checkpoint_file(self.out)
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            if state["of"] != self.of:
                raise ValueError("of another training")
            for name in ("network", "average", "optimiser"):
                getattr(self, name).load_state_dict(state[name])
            for name in self.progress:
                setattr(self, name, state[name])
            self.generator.set_state(state["generator"])
        except Exception:  # of pickle, zipfile and torch alike
            problem = "is no checkpoint of this training; remove it, or train without --resume"
            raise InputError(path, "", problem) from None


def looked(value: Tensor | float, cost: Tensor, excess_hz: Tensor) -> dict[str, float]:
    """What a look at held-out instances found: the loss, costs, (batch,), and what each exceeds, Hz."""
    mean, most = float(excess_hz.mean()), float(excess_hz.max())
    return {"held out": float(value), "cost": float(cost.mean()), "mean excess": mean, "max excess": most}


@contextlib.contextmanager
def repeatable() -> Iterator[None]:
    """Train so that results repeat: on one thread, from which these networks lose nothing."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):  # 10 bits
            yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def tensors_on(device: str) -> Iterator[None]:
    """Make tensors on a device of torch; InputError if it has none of this name."""
    try:
        torch.zeros(1, device=device)
    except (AssertionError, RuntimeError) as error:
        raise InputError("--device", device, str(error).partition("\n")[0]) from None
    with torch.device(device):
        yield


def follow_within(targets: Tensor, p_initial: Tensor, low: Tensor, high: Tensor, step: Tensor) -> Tensor:
    """Clip targets to bounds and follow them within ramps; see `knots.track`.

    Args:
        targets: shape (batch, n_knots - 1, n_gen), pu.
        p_initial: P_0, shape (batch, n_gen), pu.
        low: lower bounds, (n_gen,), pu; likewise `high`.
        high: upper bounds.
        step: largest change between two knots, (n_gen,), pu.

    Returns:
        Shape (batch, n_knots, n_gen), pu.
    """
    inside = _Clip.apply(targets, low, high)  # type: ignore[no-untyped-call]
    powers: Tensor = _Follow.apply(inside, p_initial, step)  # type: ignore[no-untyped-call]
    return powers


class _Follow(torch.autograd.Function):
    """The follower. An adjoint by hand is ten times faster than recording 150 steps."""

    @staticmethod
    def forward(ctx: Any, targets: Tensor, p_initial: Tensor, step: Tensor) -> Tensor:
        p = [p_initial]
        for target in targets.unbind(1):
            p.append(torch.maximum(torch.minimum(p[-1] + step, target), p[-1] - step))
        out = torch.stack(p, dim=1)
        ctx.save_for_backward(out, targets, step)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = gradients
        p, targets, step = ctx.saved_tensors
        # where the rate limit binds, p depends on the knot before only, elsewhere on the target only
        limited = ((targets - p[:, :-1]).abs() > step).to(gradient.dtype)
        total = []
        carry = torch.zeros_like(gradient[:, 0])
        for own, binds in zip(reversed(gradient.unbind(1)[1:]), reversed(limited.unbind(1)), strict=True):
            total.append(own + carry)
            carry = total[-1] * binds
        return torch.stack(total[::-1], dim=1) * (1.0 - limited), None, None


class _Clip(torch.autograd.Function):
    """Clip to [low, high] with a gradient that can free what is stuck outside.

    The true derivative there is zero, so that a target beyond a bound would never be told to come
    back. Here it is told, if descent leads back inside.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(value, low, high)
        return torch.minimum(torch.maximum(value, low), high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = gradients
        value, low, high = ctx.saved_tensors
        outward = ((value > high) & (gradient < 0)) | ((value < low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None
