"""The paper's DED-DPC loss on the condensed Koopman rollout, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.condensed import CondensedRollout, hat_functions
from ded_bench.surrogates.koopman import Koopman

#: Weights of the penalty terms (paper, section on the implementation).
Q_OMEGA, Q_RAMP, Q_INITIAL = 1e3, 1e2, 1e4


@dataclass(frozen=True, eq=False)
class Condensed:
    """(ω, P_s) at all grid points as an affine function of the knots: free response + Γ knots."""

    gamma: Tensor  # ((n_gen + 1) n_points, n_knots n_gen)
    hats: Tensor  # (n_points, n_knots)
    n_gen: int

    @staticmethod
    def make(case: Case, model: Koopman, grid: Array, knots: Array, dtype: torch.dtype) -> Condensed:
        """Compute Γ once for a model, a time grid and knots."""
        n_gen = len(case.generators)
        gamma = CondensedRollout.make(case, model, grid, knots).gamma
        flat = gamma.reshape((n_gen + 1) * len(grid), len(knots) * n_gen)
        return Condensed(
            torch.as_tensor(flat, dtype=dtype),
            torch.as_tensor(hat_functions(grid, knots), dtype=dtype),
            n_gen,
        )

    def to(self, device: str) -> Condensed:
        """The same on another device."""
        return Condensed(self.gamma.to(device), self.hats.to(device), self.n_gen)

    def rollout(self, free: Tensor, knots: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs under generator powers at the knots.

        Args:
            free: free response, shape (batch, n_gen + 1, n_points).
            knots: shape (batch, n_knots, n_gen), pu.

        Returns:
            ω, shape (batch, n_gen, n_points), rad/s, and P_s, shape (batch, n_points), pu.
        """
        out = free + (knots.flatten(1) @ self.gamma.T).view_as(free)
        return out[:, : self.n_gen], out[:, self.n_gen]

    def powers(self, knots: Tensor) -> Tensor:
        """Generator powers at all grid points, shape (batch, n_gen, n_points), pu."""
        return knots.transpose(1, 2) @ self.hats.T


def loss_terms(
    omega: Tensor,
    p_slack: Tensor,
    p_gen: Tensor,
    cost_gen: Tensor,
    cost_slack: Tensor,
    p_initial: Tensor,
    omega_bound: float,
    ramp: Tensor,
) -> dict[str, Tensor]:
    """The six terms of the paper's eq. (DPC_loss) for each instance, weighted, shape (batch,) each.

    Args:
        omega: (batch, n_gen, n_points), rad/s.
        p_slack: (batch, n_points), pu.
        p_gen: (batch, n_gen, n_points), pu.
        cost_gen: (batch, n_gen).
        cost_slack: (batch,).
        p_initial: P_0, (batch, n_gen), pu.
        omega_bound: rad/s.
        ramp: ε_rmp of each generator, (n_gen,), pu per step.
    """
    step = p_gen.diff(dim=2)
    return {
        "objective": (cost_gen * p_gen.sum(dim=2)).sum(dim=1) + cost_slack * p_slack.abs().sum(dim=1),
        "omega above": Q_OMEGA * _squared_excess(omega - omega_bound),
        "omega below": Q_OMEGA * _squared_excess(-omega - omega_bound),
        "ramp down": Q_RAMP * _squared_excess(-step - ramp[:, None]),
        "ramp up": Q_RAMP * _squared_excess(step - ramp[:, None]),
        "initial": Q_INITIAL * (p_gen[:, :, 0] - p_initial).square().sum(dim=1),
    }


def _squared_excess(value: Tensor) -> Tensor:
    return value.relu().square().sum(dim=(1, 2))
