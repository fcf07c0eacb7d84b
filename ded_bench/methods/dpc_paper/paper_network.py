"""The paper's control policy as a network: three convolutions over the knots, tanh to the bounds."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ded_bench.problem.case import Array

#: Output channels of the hidden layers, and the window of each layer (paper, section on the implementation).
FILTERS, WINDOWS = 30, (5, 10, 5)
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
