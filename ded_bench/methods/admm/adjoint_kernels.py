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
def modal_products(maps: Array, outputs: Array, one: Array, other: Array, found: Array) -> None:
    """One · A_i other for the parts A_i of the matrix of `modal_change`, one for each weight.

    Args:
        maps: of the mean modes, (batch, fine + 1, 2, 4, n_modes).
        outputs: see `modal_change`, (batch, 2, n_modes).
        one: modal powers at the knots, (batch, n_knots, n_modes); likewise `other`.
        other: to multiply it with.
        found: receives the sums over the batch, (4,).
    """
    found[:] = 0.0
    x, y = np.zeros(4), np.zeros(4)  # (q, q̇, v, v⁺)
    for b in range(len(one)):
        for m in range(one.shape[2]):
            x[:], y[:] = 0.0, 0.0
            for j in range(1, one.shape[1]):
                x[2], x[3] = one[b, j - 1, m], one[b, j, m]
                y[2], y[3] = other[b, j - 1, m], other[b, j, m]
                found[0] += x[3] * y[3]
                found[1] += (x[3] - x[2]) * (y[3] - y[2])
                for i in range(1, maps.shape[1]):
                    to_q, to_speed = maps[b, i, 0, :, m], maps[b, i, 1, :, m]
                    found[2] += outputs[b, 0, m] * (to_speed * x).sum() * (to_speed * y).sum()
                    found[3] += outputs[b, 1, m] * (to_q * x).sum() * (to_q * y).sum()
                last_q, last_speed = maps[b, -1, 0, :, m], maps[b, -1, 1, :, m]
                x[0], x[1] = (last_q * x).sum(), (last_speed * x).sum()
                y[0], y[1] = (last_q * y).sum(), (last_speed * y).sum()
