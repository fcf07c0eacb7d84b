"""The loss of `ded-dpc`: relative cost and an exact penalty on the frequency bound, on a coarser grid.

Everything but the frequency bound holds by construction (see `follower`), so that only two terms
remain. Both are evaluated on the condensed rollout (`koopman.condensed`) at every tenth of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ded_bench.koopman.condensed import CondensedRollout, free_response
from ded_bench.koopman.model import Koopman
from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.methods.dpc.response import Array32
from ded_bench.problem.case import Array
from ded_bench.truth.network import Network

#: Spacing of the points at which P_s and ω are evaluated, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.1
#: Instances rolled out at once.
CHUNK = 500


@dataclass(frozen=True, eq=False)
class Objective:
    """(ω, P_s) at the coarse points, and the cost, as functions of the knots."""

    gamma: Tensor  # Γ, ((n_gen + 1) n_coarse, n_knots n_gen)
    hat_weights: Tensor  # sum over the grid of each knot's hat function, (n_knots,)
    quadrature_weights: Tensor  # of a sum over the grid, taken at the coarse points, (n_coarse,)
    n_gen: int

    @staticmethod
    def make(condensed: CondensedRollout, dtype: torch.dtype = torch.float32) -> Objective:
        """The condensed rollout as tensors."""
        return Objective(
            torch.as_tensor(condensed.gamma.reshape(-1, condensed.gamma.shape[2]), dtype=dtype),
            torch.as_tensor(condensed.hat_weights, dtype=dtype),
            torch.as_tensor(condensed.quadrature_weights, dtype=dtype),
            condensed.n_gen,
        )

    def to(self, device: str) -> Objective:
        """The same on another device."""
        hat_weights, quadrature_weights = self.hat_weights.to(device), self.quadrature_weights.to(device)
        return Objective(self.gamma.to(device), hat_weights, quadrature_weights, self.n_gen)

    def rollout(self, free: Tensor, p_gen: Tensor) -> tuple[Tensor, Tensor]:
        """ω (batch, n_gen, n_coarse), rad/s, and P_s (batch, n_coarse), pu, under powers at the knots."""
        out = free + (p_gen.flatten(1) @ self.gamma.T).view_as(free)
        return out[:, : self.n_gen], out[:, self.n_gen]

    def cost(self, p_gen: Tensor, p_slack: Tensor, cost: Tensor) -> Tensor:
        """Σ_k Σ_i c_i P_i + c_s |P_s| over the whole grid, shape (batch,).

        Args:
            p_gen: at the knots, (batch, n_knots, n_gen), pu.
            p_slack: at the coarse points, (batch, n_coarse), pu.
            cost: (slack, generators), (batch, 1 + n_gen).
        """
        generators = (torch.einsum("bkg,k->bg", p_gen, self.hat_weights) * cost[:, 1:]).sum(dim=1)
        return generators + cost[:, 0] * (p_slack.abs() @ self.quadrature_weights)


def coarse_stride(dt_s: float, steps: int, spacing_s: float = SPACING_S) -> int:
    """Largest divisor of the number of steps that keeps to a spacing."""
    most = max(1, round(spacing_s / dt_s))
    return next(s for s in range(most, 0, -1) if steps % s == 0)


def coarse_free_response(
    network: Network, model: Koopman, inputs: Inputs, grid: Array, stride: int
) -> Array32:
    """`condensed.free_response` of instances, (batch, n_gen + 1, n_coarse), float32."""
    parts = []
    for start in range(0, len(inputs), CHUNK):
        part = inputs[start : start + CHUNK]
        p_load = part.p_load(grid)
        theta = network.power_flow(part.p_initial, p_load[:, 0])
        delta, omega = np.hsplit(part.state, 2)
        if delta.any():
            theta[:, network.generators] += delta
            theta, _ = network.solve_loads(theta, network.load_injections(p_load[:, 0]))
        psi = model.observables(network, theta, omega, p_load[:, 0])
        parts.append(free_response(model, psi, p_load, stride).astype(np.float32))
    return np.concatenate(parts)
