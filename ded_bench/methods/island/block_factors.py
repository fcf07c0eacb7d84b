"""Factors of a matrix with blocks beside its diagonal alone, and a part of low rank: C = T + Φ' Φ / ρ.

Set-points act on swings for a few knots, which gives T, and on the mean frequency for all time to come, which
gives Φ. By blocks, and by the formula of Sherman, Morrison and Woodbury, a solution takes a part of what the
inverse of C would take, which has an entry for any two set-points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.problem.compiled import compiled
from ded_bench.problem.quantities import Array, Array32


class Factors(NamedTuple):
    """What solves C x = r."""

    inverse: Array32  # of the blocks of the diagonal of D in T = (1 + E) D (1 + E)', (n_blocks, size, size)
    before: Array32  # blocks of E, beside the diagonal, the first of no use, (n_blocks, size, size)
    low_rank: Array32  # R, where the inverse of C is that of T less R' R, (n_intervals, n_columns)


def factored(near: Array, phi: Array, rho: float, size: int, right: Array) -> tuple[Factors, Array]:
    """Factors in single precision, and one solution in double.

    Args:
        near: T, (n_columns, n_columns).
        phi: Φ, (n_rows, n_columns).
        rho: ρ.
        size: of a block; T has none but of neighbours.
        right: of the solution, (n_columns, n_right).
    """
    both = np.linalg.solve(near, np.hstack([phi.T, right]))
    weak, answer = both[:, : len(phi)], both[:, len(phi) :]
    low_rank = np.linalg.solve(np.linalg.cholesky(rho * np.eye(len(phi)) + phi @ weak), weak.T)
    n_blocks = -(-len(near) // size)
    padded = np.eye(n_blocks * size)
    padded[: len(near), : len(near)] = near
    blocks = padded.reshape(n_blocks, size, n_blocks, size).swapaxes(1, 2)
    inverse, before = np.zeros((2, n_blocks, size, size))
    inverse[0] = np.linalg.inv(blocks[0, 0])
    for k in range(1, n_blocks):
        before[k] = blocks[k, k - 1] @ inverse[k - 1]
        inverse[k] = np.linalg.inv(blocks[k, k] - before[k] @ blocks[k, k - 1].T)
    factors = Factors(*(part.astype(np.float32) for part in (inverse, before, low_rank)))
    return factors, answer - low_rank.T @ (low_rank @ right)


@compiled
def solve(factors: Factors, right: Array32) -> Array32:
    """Solve C x = r, (n_columns,)."""
    n_blocks, size, _ = factors.inverse.shape
    x = np.zeros((n_blocks, size), dtype=np.float32)
    flat, n = x.ravel(), len(right)
    flat[:n] = right
    for k in range(1, n_blocks):
        x[k] -= np.dot(factors.before[k], x[k - 1])
    for k in range(n_blocks - 1, -1, -1):
        x[k] = np.dot(factors.inverse[k], x[k])
        if k + 1 < n_blocks:
            x[k] -= np.dot(x[k + 1], factors.before[k + 1])
    far = np.dot(np.dot(factors.low_rank, right), factors.low_rank)
    found: Array32 = flat[:n] - far
    return found
