"""What training alone compiles: the follower's transpose, and derivatives by an iteration's weights."""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def track_rows_adjoint(
    targets: Array, powers: Array, low: Array, high: Array, step: Array, on_powers: Array, on_targets: Array
) -> None:
    """Gradient in the targets of a function with this gradient in the powers of `track_rows`.

    Where a target lies beyond a bound, its gradient is kept if descent leads back inside.

    Args:
        targets: (batch, n_knots, n_gen), pu; likewise `powers` and both gradients.
        powers: that follow them.
        low: (n_gen,), pu; likewise `high` and `step`.
        on_powers: the gradient.
        on_targets: receives it; 0 at the first knot.
    """
    for b in range(len(targets)):
        carry = np.zeros(targets.shape[2])
        for j in range(targets.shape[1] - 1, 0, -1):
            for g in range(targets.shape[2]):
                wanted = targets[b, j, g]
                inside = min(max(wanted, low[g]), high[g])
                whole = on_powers[b, j, g] + carry[g]
                limited = abs(inside - powers[b, j - 1, g]) > step[g]
                carry[g] = whole if limited else 0.0
                own = 0.0 if limited else whole
                outward = (wanted > high[g] and own < 0.0) or (wanted < low[g] and own > 0.0)
                on_targets[b, j, g] = 0.0 if outward else own
        on_targets[b, 0] = 0.0


@compiled
def modal_products(step: Array, leverage: Array, fine: int, one: Array, other: Array, found: Array) -> None:
    """One · A_i other for the parts A_i of the matrix of `modal_change`, one for each weight.

    Args:
        step: of the mean modes, (batch, n_modes, 2, 4).
        leverage: what a mode takes from the slack, (batch, n_modes), pu/rad.
        fine: fine points per interval.
        one: modal powers at the knots, (batch, n_knots, n_modes); likewise `other`.
        other: to multiply it with.
        found: receives the sums over the batch, (4,).
    """
    found[:] = 0.0
    state = np.empty((2, 2))
    for b in range(len(one)):
        for m in range(one.shape[2]):
            state[:] = 0.0
            a = step[b, m]
            for j in range(1, one.shape[1]):
                x, y, x_before, y_before = one[b, j, m], other[b, j, m], one[b, j - 1, m], other[b, j - 1, m]
                found[0] += x * y
                found[1] += (x - x_before) * (y - y_before)
                for i in range(fine):
                    here, there = i / fine, (i + 1) / fine
                    for side, v, before in ((0, x, x_before), (1, y, y_before)):
                        q, speed = state[side, 0], state[side, 1]
                        now, later = before + here * (v - before), before + there * (v - before)
                        state[side, 0] = a[0, 0] * q + a[0, 1] * speed + a[0, 2] * now + a[0, 3] * later
                        state[side, 1] = a[1, 0] * q + a[1, 1] * speed + a[1, 2] * now + a[1, 3] * later
                    found[2] += state[0, 1] * state[1, 1]
                    found[3] += leverage[b, m] ** 2 * state[0, 0] * state[1, 0]
