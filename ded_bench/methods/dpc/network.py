"""The network of `ded-dpc`: dilated residual convolutions over the knots, in torch and in NumPy.

It corrects the static dispatch: targets = prior + half range × output. Constants of the instance
(costs, P_0, ω(0)) enter once, as a bias of every layer. The NumPy twin answers a single instance
in a tenth of a millisecond, where torch's overhead per layer would dominate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from numpy.typing import NDArray
from torch import Tensor, nn

from ded_bench.methods.dpc.inputs import Channels, n_channels, sequence_groups
from ded_bench.problem.case import Array, Case

Array32 = NDArray[np.float32]
#: With windows of three these dilations reach 31 knots to either side.
DILATIONS = (1, 2, 4, 8, 16, 1)
WIDTH, EMBEDDING = 32, 64
#: Channels divided by this are no input any more.
HIDDEN_SCALE = 1e30


class ResidualNetwork(nn.Module):
    """Channels in, corrections of the static dispatch out (in half ranges of each generator).

    Convolutions run along the second axis of images one pixel high: with channels stored last, as
    they come, that is a third faster to train on a CPU than one-dimensional convolutions.
    """

    def __init__(self, n_sequence: int, n_constants: int, n_gen: int, width: int, dilations: tuple[int, ...]):
        super().__init__()
        self.width, self.dilations = width, dilations
        self.first = nn.Conv2d(n_sequence, width, (1, 3), padding=(0, 1))
        self.embed = nn.Sequential(
            nn.Linear(n_constants, EMBEDDING), nn.ReLU(), nn.Linear(EMBEDDING, width * (1 + len(dilations)))
        )
        self.spread = nn.ModuleList(
            nn.Conv2d(width, width, (1, 3), padding=(0, d), dilation=(1, d)) for d in dilations
        )
        self.mix = nn.ModuleList(nn.Conv2d(width, width, 1) for _ in dilations)
        self.last = nn.Conv2d(width, n_gen, 1)
        with torch.no_grad():
            for layer in self.mix:
                layer.weight.mul_(0.5)  # type: ignore[operator]
        nn.init.zeros_(self.last.weight)  # training starts from the static dispatch
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]
        for name, n in (("sequence", n_sequence), ("constants", n_constants)):
            self.register_buffer(f"{name}_mean", torch.zeros(n))
            self.register_buffer(f"{name}_scale", torch.ones(n))

    sequence_mean: Tensor
    sequence_scale: Tensor
    constants_mean: Tensor
    constants_scale: Tensor

    @staticmethod
    def make(case: Case, width: int = WIDTH, dilations: tuple[int, ...] = DILATIONS) -> ResidualNetwork:
        """An untrained network for a case."""
        return ResidualNetwork(*n_channels(case), len(case.generators), width, dilations)

    def normalise(self, channels: Channels) -> None:
        """Set the affine input normalisation from training data."""
        for name in ("sequence", "constants"):
            values = getattr(channels, name).reshape(-1, getattr(channels, name).shape[-1])
            getattr(self, f"{name}_mean").copy_(torch.as_tensor(values.mean(axis=0)))
            getattr(self, f"{name}_scale").copy_(torch.as_tensor(values.std(axis=0)).clamp_min(1e-6))

    def hide(self, case: Case, groups: Sequence[str]) -> None:
        """Scale groups of sequence channels to nothing (see `inputs.sequence_groups`)."""
        for name in groups:
            self.sequence_scale[sequence_groups(case)[name]] = HIDDEN_SCALE

    def forward(self, sequence: Tensor, constants: Tensor) -> Tensor:
        """Corrections, shape (batch, n_knots, n_gen), from `Channels` in float32."""
        x = ((sequence - self.sequence_mean) / self.sequence_scale).transpose(1, 2)[:, :, None]
        embedded = self.embed((constants - self.constants_mean) / self.constants_scale)
        bias = embedded.unflatten(1, (-1, self.width, 1, 1))
        h = self.first(x) + bias[:, 0]
        for i, (spread, mix) in enumerate(zip(self.spread, self.mix, strict=True)):
            h = h + mix(F.relu(spread(h) + bias[:, i + 1]))
        corrections: Tensor = self.last(F.relu(h))[:, :, 0].transpose(1, 2)
        return corrections


class NumpyNetwork:
    """The same function as a ResidualNetwork, for inference without torch."""

    def __init__(self, network: ResidualNetwork) -> None:
        state = {name: value.detach().cpu().numpy() for name, value in network.state_dict().items()}
        scale = 1.0 / state["sequence_scale"]
        self._shift, self._scale = state["sequence_mean"], scale
        # normalisation of the constants and biases of the convolutions go into the embedding
        weight = state["embed.0.weight"] / state["constants_scale"]
        self._enter = weight.T.copy(), state["embed.0.bias"] - weight @ state["constants_mean"]
        n = len(network.spread)
        bias = [state["first.bias"], *(state[f"spread.{i}.bias"] for i in range(n))]
        self._embed = state["embed.2.weight"].T.copy(), state["embed.2.bias"] + np.concatenate(bias)
        self._first = _window(state["first.weight"])
        self._blocks = [
            (
                network.dilations[i],
                _window(state[f"spread.{i}.weight"]),
                state[f"mix.{i}.weight"][:, :, 0, 0].T.copy(),
                state[f"mix.{i}.bias"],
            )
            for i in range(n)
        ]
        self._last = state["last.weight"][:, :, 0, 0].T.copy(), state["last.bias"]
        self._width = network.width

    def __call__(self, channels: Channels) -> Array:
        """Corrections, shape (batch, n_knots, n_gen)."""
        sequence = ((channels.sequence - self._shift) * self._scale).astype(np.float32)
        hidden = np.maximum(channels.constants.astype(np.float32) @ self._enter[0] + self._enter[1], 0.0)
        bias = (hidden @ self._embed[0] + self._embed[1]).reshape(len(hidden), -1, 1, self._width)
        batch, n, _ = sequence.shape
        width, margin = self._width, max((dilation for dilation, *_ in self._blocks), default=1)
        # zeros before the first knot and after the last; from here on in place, since memory costs time
        padded = np.zeros((batch, n + 2 * margin, width), dtype=np.float32)
        columns = np.empty((batch * n, 3 * width), dtype=np.float32)
        inner, change = np.empty((2, batch, n, width), dtype=np.float32)
        windows = columns.reshape(batch, n, 3, width)
        inner_rows, change_rows = inner.reshape(-1, width), change.reshape(-1, width)
        h = padded[:, margin : margin + n]
        h += _neighbours(_padded(sequence), n, 1).reshape(batch, n, -1) @ self._first
        h += bias[:, 0]
        for i, (dilation, spread, mix, offset) in enumerate(self._blocks):
            np.copyto(windows, _neighbours(padded, n, dilation))
            np.dot(columns, spread, out=inner_rows)
            inner += bias[:, i + 1]
            np.maximum(inner, 0.0, out=inner)
            np.dot(inner_rows, mix, out=change_rows)
            h += change
            h += offset
        weight, offset = self._last
        corrections = np.maximum(h, 0.0).reshape(-1, width) @ weight + offset
        return np.asarray(corrections, dtype=np.float64).reshape(batch, n, -1)


def _window(weight: Array32) -> Array32:
    """A convolution's weight (out, in, 1, 3) as a matrix for `_neighbours`, (3 in, out)."""
    return np.ascontiguousarray(weight[:, :, 0].transpose(2, 1, 0).reshape(-1, len(weight)))


def _padded(x: Array32) -> Array32:
    """One row of zeros on either side."""
    batch, n, width = x.shape
    out = np.zeros((batch, n + 2, width), dtype=np.float32)
    out[:, 1:-1] = x
    return out


def _neighbours(padded: Array32, n: int, dilation: int) -> Array32:
    """Each of n knots beside those `dilation` before and after it: a view, (batch, n, 3, width)."""
    batch, length, width = padded.shape
    first = (length - n) // 2 - dilation
    per_batch, per_knot, per_channel = padded.strides
    return np.ndarray(
        (batch, n, 3, width),
        np.float32,
        padded,
        first * per_knot,
        (per_batch, per_knot, dilation * per_knot, per_channel),
    )
