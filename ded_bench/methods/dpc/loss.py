"""The loss of `ded-dpc`: relative cost and an exact penalty on the frequency bound, on a coarser grid.

Everything but the frequency bound holds by construction (see `ramp_follower`), so that only two terms
remain. Both are evaluated on the condensed rollout (`koopman.condensed`) at every tenth of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ded_bench.surrogates.condensed import CondensedRollout


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
