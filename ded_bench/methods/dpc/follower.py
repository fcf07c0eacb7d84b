"""Schedules that meet bounds, ramps and P_0 whatever is asked: a rate-limited follower of targets.

    p_0 = P_0,   p_{j+1} = p_j + clip(target_{j+1} - p_j, -step, step)

with targets clipped to the generator bounds and `step` the ramp limit times the spacing of the
knots. By induction p stays within bounds if P_0 is. Between knots a schedule is linear, so no two
neighbouring grid points differ by more than the limit.
"""

from __future__ import annotations

import numpy as np

from ded_bench.methods.dpc.kernels import track
from ded_bench.problem.case import Array


def follow(targets: Array, p_initial: Array, step: Array) -> Array:
    """Follow targets in float64.

    Args:
        targets: within bounds, shape (batch, n_knots - 1, n_gen), pu.
        p_initial: P_0, shape (batch, n_gen), pu.
        step: largest change between two knots, (n_gen,), pu.

    Returns:
        Shape (batch, n_knots, n_gen), pu.
    """
    p_gen = np.concatenate([p_initial[:, None], targets], axis=1)
    for powers in p_gen:
        track(powers.T, step, powers.T)
    return p_gen
