"""DED-DPC: a trained policy that answers with a schedule in less than a millisecond.

`ded-dpc-paper` is the paper's architecture: three Conv1d layers over 50 knots, tanh to the generator
bounds, linear interpolation. Policy files are safetensors: arrays and a JSON header.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc_paper.paper_features import Features
from ded_bench.methods.dpc_paper.paper_loss import knot_times
from ded_bench.methods.policy_file import (
    Scope,
    find_policy_file,
    load_weights,
    read_policy,
    weights_fingerprint,
    write_policy,
)
from ded_bench.methods.policy_solver import method
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.network import Network

SETTINGS: dict[str, dict[str, Any]] = {"default": {}}
METHOD = "ded-dpc-paper"
N_KNOTS, FILTERS, WINDOWS = 50, 30, (5, 10, 5)
ZERO = np.float32(0.0)


class PaperNetwork(nn.Module):
    """The paper's control policy: channels over the knots in, generator powers at the knots out."""

    def __init__(self, n_channels: int, p_min: Array, p_max: Array) -> None:
        super().__init__()
        first, middle, last = WINDOWS
        self.layers = nn.Sequential(
            _same_padding(first),
            nn.Conv1d(n_channels, FILTERS, first),
            nn.ReLU(),
            _same_padding(middle),
            nn.Conv1d(FILTERS, FILTERS, middle),
            nn.ReLU(),
            _same_padding(last),
            nn.Conv1d(FILTERS, len(p_min), last),
        )
        self.register_buffer("mean", torch.zeros(n_channels, 1))
        self.register_buffer("scale", torch.ones(n_channels, 1))
        self.register_buffer("p_min", torch.as_tensor(p_min, dtype=torch.float32)[:, None])
        self.register_buffer("p_max", torch.as_tensor(p_max, dtype=torch.float32)[:, None])

    mean: Tensor
    scale: Tensor
    p_min: Tensor
    p_max: Tensor

    def normalise(self, channels: Tensor) -> None:
        """Set the affine input normalisation from training data, (batch, n_channels, n_knots)."""
        self.mean.copy_(channels.mean(dim=(0, 2))[:, None])
        self.scale.copy_(channels.std(dim=(0, 2))[:, None].clamp_min(1e-6))

    def forward(self, channels: Tensor) -> Tensor:
        """Map (batch, n_channels, n_knots) to powers, (batch, n_knots, n_gen), pu, within bounds."""
        out = self.layers((channels - self.mean) / self.scale)
        power = self.p_min + 0.5 * (1.0 + torch.tanh(out)) * (self.p_max - self.p_min)
        return power.transpose(1, 2)


def _same_padding(window: int) -> nn.Module:
    """Zeros on both sides, so that a convolution with this window keeps the length."""
    return nn.ConstantPad1d(((window - 1) // 2, window // 2), 0.0)


class NumpyPaperNetwork:
    """The same function as a PaperNetwork: for one instance torch's overhead would be most of the time."""

    def __init__(self, network: PaperNetwork) -> None:
        state = {name: value.detach().cpu().numpy() for name, value in network.state_dict().items()}
        self._mean, self._scale = state["mean"], 1.0 / state["scale"]
        self._low, self._half = state["p_min"], 0.5 * (state["p_max"] - state["p_min"])
        weights = [value for name, value in state.items() if name.endswith(".weight")]  # (out, in, window)
        matrices = [w.transpose(0, 2, 1).reshape(len(w), -1) for w in weights]
        biases = [value[:, None] for name, value in state.items() if name.endswith(".bias")]
        self._layers = list(zip(WINDOWS, matrices, biases, strict=True))

    def __call__(self, channels: Array) -> Array:
        """See `PaperNetwork.forward`."""
        h = (channels.astype(np.float32) - self._mean) * self._scale
        for i, (window, weight, bias) in enumerate(self._layers):
            if i:
                np.maximum(h, ZERO, out=h)
            h = np.matmul(weight, _windows(h, window))
            h += bias
        np.tanh(h, out=h)
        h += 1.0
        power = self._low + self._half * h
        return np.asarray(power.swapaxes(1, 2), dtype=np.float64)


def _windows(x: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    """What a convolution sees at each knot, zeros outside, (batch, window * width, n)."""
    batch, width, n = x.shape
    padded = np.zeros((batch, width, n + window - 1), dtype=np.float32)
    before = (window - 1) // 2
    padded[:, :, before : before + n] = x
    per_instance, per_channel, per_knot = padded.strides
    strides = per_instance, per_knot, per_channel, per_knot
    seen = np.ndarray((batch, window, width, n), np.float32, padded, strides=strides)
    return seen.reshape(batch, -1, n)


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained network with all that is needed to apply it, for one case, regime and horizon."""

    case: Case
    regime: str
    horizon_s: float
    network: PaperNetwork
    training: dict[str, Any]

    @functools.cached_property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return knot_times(self.horizon_s, N_KNOTS)

    @functools.cached_property
    def _grid(self) -> Network:
        return Network(self.case)

    @functools.cached_property
    def _numpy(self) -> NumpyPaperNetwork:
        return NumpyPaperNetwork(self.network)

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self._scope.check(batch)
        powers = self._numpy(Features.of(self._grid, batch, self.knots).channels())
        powers = np.minimum(np.maximum(powers, self.case.p_min), self.case.p_max)  # again, in float64
        return [Schedule(self.knots, p) for p in powers]

    @property
    def _scope(self) -> Scope:
        return Scope(self.case, self.regime, self.horizon_s)

    def save(self, path: Path) -> None:
        """Write weights, normalisation and header."""
        write_policy(path, METHOD, self._scope, self.network, self.training)

    @staticmethod
    def load(path: str | Path, case: Case, regime: str) -> Policy:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, METHOD, case, regime)
        network = PaperNetwork(n_channels(case), case.p_min, case.p_max)
        load_weights(network, arrays, path)
        return Policy(case, regime, scope.horizon_s, network.eval(), training)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.network)


def n_channels(case: Case) -> int:
    """Channels of `Features`: loads, costs, x_0 and P_0."""
    return len(case.loads) + (1 + len(case.generators)) + len(case.buses) + 2 * len(case.generators)


def find_policy(case: Case, regime: str, settings: Settings) -> Policy:
    """Return the policy given in the settings, else the first one in the folders to search.

    Raises:
        InputError: there is none (names the command that trains one), or it does not fit.
    """
    return Policy.load(find_policy_file(METHOD, case, regime, settings), case, regime)


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    path = find_policy_file(METHOD, case, regime, settings)
    return (Artifact("policy", METHOD, Policy.load(path, case, regime).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method."""
    return method(find_policy(case, regime, settings))
