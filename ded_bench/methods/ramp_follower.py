"""Schedules that follow targets as fast as bounds and ramp limits allow, whatever is asked.

    p_0 = P_0,   p_{j+1} = min(max(clip(target_{j+1}), p_j - step), p_j + step)

with `step` the ramp limit times the spacing of the knots. By induction p stays within the generator bounds if
P_0 is. Between knots a schedule is linear, so no two neighbouring grid points differ by more than the limit.
"""

from __future__ import annotations

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def track(p_gen: Array, low: Array, high: Array, step: Array) -> None:
    """Turn the targets of a batch into powers, in place.

    Args:
        p_gen: P_0, then the targets, shape (batch, n_knots, n_gen), pu.
        low: lower bounds, (n_gen,), pu; likewise `high`.
        high: upper bounds.
        step: largest change between two knots, (n_gen,), pu.
    """
    for b in range(p_gen.shape[0]):
        for j in range(1, p_gen.shape[1]):
            for g in range(p_gen.shape[2]):
                before = p_gen[b, j - 1, g]
                target = min(max(p_gen[b, j, g], low[g]), high[g])
                p_gen[b, j, g] = min(max(target, before - step[g]), before + step[g])
