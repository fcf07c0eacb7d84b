"""Schedules that follow targets as fast as ramp limits allow, whatever is asked.

    p_0 = P_0,   p_{j+1} = min(max(target_{j+1}, p_j - step), p_j + step)

with `step` the ramp limit times the spacing of the knots. By induction p stays within the generator
bounds if P_0 and the targets are. Between knots a schedule is linear, so no two neighbouring grid points
differ by more than the limit.
"""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def track(p_gen: Array, step: Array) -> None:
    """Turn the targets of a batch into powers, in place.

    Args:
        p_gen: P_0, then the targets, shape (batch, n_gen, n_knots), pu.
        step: largest change between two knots, (n_gen,), pu.
    """
    for b in range(len(p_gen)):
        for g in range(p_gen.shape[1]):
            p = p_gen[b, g, 0]
            for j in range(1, p_gen.shape[2]):
                p = min(max(p_gen[b, g, j], p - step[g]), p + step[g])
                p_gen[b, g, j] = p


def follow(targets: Array, p_initial: Array, step: Array) -> Array:
    """Follow the targets of a batch.

    Args:
        targets: shape (batch, n_knots - 1, n_gen), pu.
        p_initial: P_0, shape (batch, n_gen), pu.
        step: largest change between two knots, (n_gen,), pu.

    Returns:
        Shape (batch, n_knots, n_gen), pu.
    """
    p_gen = np.concatenate([p_initial[:, None], targets], axis=1)
    track(p_gen.swapaxes(1, 2), step)
    return p_gen
