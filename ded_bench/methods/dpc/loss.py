"""The loss of `ded-dpc`: relative cost and an exact penalty on the frequency bound, on a coarser grid.

Everything but the frequency bound holds by construction (see `follower`), so that only two terms
remain. Both are evaluated on the condensed rollout at every tenth of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ded_bench.koopman.model import Koopman, hat_functions
from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.problem.case import Array, Case
from ded_bench.truth.network import Network

#: Spacing of the points at which P_s and ω are evaluated, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.1
#: Instances rolled out at once.
CHUNK = 500


@dataclass(frozen=True, eq=False)
class Objective:
    """(ω, P_s) at the coarse points, and the cost, as functions of the knots."""

    gamma: Tensor  # ((n_gen + 1) n_coarse, n_knots n_gen)
    held: Tensor  # Σ_k over the grid of each knot's hat function, (n_knots,)
    stands_for: Tensor  # grid points that a coarse point stands for, (n_coarse,)
    n_gen: int

    @staticmethod
    def make(
        case: Case, model: Koopman, grid: Array, knots: Array, stride: int, dtype: torch.dtype = torch.float32
    ) -> Objective:
        """Condense a model on every `stride`-th point of a grid."""
        n_gen = len(case.generators)
        gamma = np.moveaxis(model.condense(n_gen, grid, knots)[::stride], 1, 0)
        weights = hat_functions(grid, grid[::stride]).sum(axis=0)
        return Objective(
            torch.as_tensor(gamma.reshape(-1, len(knots) * n_gen), dtype=dtype),
            torch.as_tensor(hat_functions(grid, knots).sum(axis=0), dtype=dtype),
            torch.as_tensor(weights, dtype=dtype),
            n_gen,
        )

    def to(self, device: str) -> Objective:
        """The same on another device."""
        return Objective(self.gamma.to(device), self.held.to(device), self.stands_for.to(device), self.n_gen)

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
        generators = (torch.einsum("bkg,k->bg", p_gen, self.held) * cost[:, 1:]).sum(dim=1)
        return generators + cost[:, 0] * (p_slack.abs() @ self.stands_for)


def coarse_stride(dt_s: float, steps: int, spacing_s: float = SPACING_S) -> int:
    """Largest divisor of the number of steps that keeps to a spacing."""
    most = max(1, round(spacing_s / dt_s))
    return next(s for s in range(most, 0, -1) if steps % s == 0)


def coarse_free_response(
    network: Network, model: Koopman, inputs: Inputs, grid: Array, stride: int
) -> np.ndarray:
    """`Koopman.free_response` at every `stride`-th grid point, (batch, n_gen + 1, n_coarse), float32.

    A coarse step sums what the load changes inside it leave behind, so that the result is the same
    as of the step-by-step rollout, in a tenth of the time.
    """
    n_gen, parts = len(network.generators), []
    powers = [np.eye(len(model.k))]
    for _ in range(stride):
        powers.append(powers[-1] @ model.k)
    kicks = (model.g - model.b)[:, n_gen:]
    leave = np.concatenate([(powers[stride - 1 - m] @ kicks).T for m in range(stride)])
    for start in range(0, len(inputs), CHUNK):
        part = inputs[start : start + CHUNK]
        p_load = part.p_load(grid)
        psi = model.observables(
            network, network.power_flow(part.p_initial, p_load[:, 0]), part.omega, p_load[:, 0]
        )
        steady = p_load[:, ::stride] @ model.b[:, n_gen:].T
        push = np.diff(p_load, axis=1).reshape(len(part), -1, stride * p_load.shape[2]) @ leave
        away = np.empty_like(steady)
        away[:, 0] = psi - steady[:, 0]
        for step in range(push.shape[1]):
            away[:, step + 1] = away[:, step] @ powers[stride].T + push[:, step]
        parts.append((away + steady)[:, :, : n_gen + 1].transpose(0, 2, 1).astype(np.float32))
    return np.concatenate(parts)
