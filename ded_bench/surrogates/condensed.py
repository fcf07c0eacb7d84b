"""The condensed rollout: (ω, P_s) as an affine map of the generators' powers at a few knots.

A rollout is affine in its inputs, and these are linear between knots, so that

    (ω, P_s) = free response + Γ knots

where the free response has ψ_0 and the loads but no generator power. Losses and refinement
use this map, at all grid points or at every `stride`-th of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.koopman import Koopman, linear_recurrence


@dataclass(frozen=True, eq=False)
class CondensedRollout:
    """(ω, P_s) at the points of a time grid, or at every `stride`-th of them, from powers at knots."""

    model: Koopman
    stride: int
    knots: Array  # times, (n_knots,), s
    points: Array  # times, (n_points,), s
    gamma: Array  # Γ by output, (n_gen + 1, n_points, n_knots n_gen): ω in rad/s, P_s in pu, per pu
    hat_weights: Array  # sum over the whole grid of each knot's hat function, (n_knots,)
    quadrature_weights: Array  # a sum over the whole grid, taken at the points, (n_points,)

    @staticmethod
    def make(case: Case, model: Koopman, grid: Array, knots: Array, stride: int = 1) -> CondensedRollout:
        """Condense a model of a case.

        Args:
            case: gives the generators.
            model: the surrogate; its step is that of the grid.
            grid: times t_k, shape (n_grid,), s.
            knots: knot times, shape (n_knots,), s.
            stride: outputs are taken at every so many grid points; it divides the number of steps.
        """
        n_gen, points = len(case.generators), grid[::stride]
        hats = hat_functions(grid, knots)
        gamma = np.empty((n_gen + 1, len(points), len(knots), n_gen))
        at_rest = np.zeros((len(knots), len(model.k)))
        for g in range(n_gen):  # one generator at a time: the states of all would fill the memory
            response = _rollout(model, at_rest, hats.T[:, :, None], slice(g, g + 1), stride)
            gamma[..., g] = response[:, : n_gen + 1].transpose(1, 2, 0)
        return CondensedRollout(
            model,
            stride,
            knots,
            points,
            gamma.reshape(n_gen + 1, len(points), -1),
            hats.sum(axis=0),
            hat_functions(grid, points).sum(axis=0) if stride > 1 else np.ones(len(grid)),
        )

    @property
    def n_gen(self) -> int:
        """Number of generators."""
        return len(self.gamma) - 1


def free_response(model: Koopman, psi: Array, p_load: Array, stride: int = 1) -> Array:
    """(ω, P_s) without generator power, at every `stride`-th grid point.

    Args:
        model: the surrogate.
        psi: ψ_0, (batch, n_psi).
        p_load: load injections at all grid points, (batch, n_grid, n_load), pu.
        stride: divides the number of steps.

    Returns:
        Shape (batch, n_gen + 1, n_points): rad/s, pu.
    """
    n_gen = model.b.shape[1] - p_load.shape[2]
    return _rollout(model, psi, p_load, slice(n_gen, None), stride)[:, : n_gen + 1]


def _rollout(model: Koopman, psi: Array, inputs: Array, columns: slice, stride: int) -> Array:
    """ψ at every `stride`-th point under some of the inputs, the others zero.

    A step of `stride` points sums what the input increments inside it contribute at its end, so that
    the result is that of the step-by-step rollout.

    Args:
        model: the surrogate.
        psi: ψ_0, (batch, n_psi).
        inputs: (batch, n_grid, n_columns), pu.
        columns: which of the model's inputs these are.
        stride: divides the number of steps.

    Returns:
        Shape (batch, n_psi, n_points).
    """
    batch, n_columns = len(inputs), inputs.shape[2]
    steady = inputs[:, ::stride] @ model.b[:, columns].T
    at_end, power = [(model.g - model.b)[:, columns].T], model.k
    for _ in range(stride - 1):
        at_end.append(at_end[-1] @ model.k.T)
        power = power @ model.k
    increments = np.diff(inputs, axis=1).reshape(batch, -1, stride * n_columns)
    increments = increments @ np.concatenate(at_end[::-1])
    deviation = linear_recurrence(power, psi - steady[:, 0], np.moveaxis(increments, 1, 0))
    return np.asarray(np.moveaxis(deviation, 0, 2) + steady.transpose(0, 2, 1))


def hat_functions(grid: Array, knots: Array) -> Array:
    """Linear interpolation as a matrix, shape (n_grid, n_knots): values(grid) = hats @ values(knots)."""
    return np.stack([np.interp(grid, knots, row) for row in np.eye(len(knots))], axis=1)
