"""The paper's control policy as a network: three convolutions over the knots, tanh to the bounds."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ded_bench.methods.dpc_paper.paper_inference import FILTERS, WINDOWS
from ded_bench.problem.case import Array


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
