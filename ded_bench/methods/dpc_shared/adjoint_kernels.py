"""What training alone compiles: transposed recursions, and the follower with the batch last."""

from __future__ import annotations

import numpy as np

from ded_bench.methods.dpc_shared.stage_records import Array32, Modes
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def swing_adjoint(modes: Modes, change: Array, on_q: Array, on_speed: Array, on_v: Array) -> None:
    """Gradient in the inputs of a function with these gradients in q and q̇; the transpose of `swing`.

    The kick by damping after a step is taken with the speed before it, and C is symmetric.

    Args:
        modes: the grid.
        change: see `swing`.
        on_q: (batch, n_fine, n_modes).
        on_speed: likewise.
        on_v: receives the gradient, likewise.
    """
    n = on_v.shape[2]
    by_q, by_speed, by_kicked = np.zeros(n), np.zeros(n), np.zeros(n)
    kick, total = np.empty(n), np.empty(n)
    for b in range(len(on_v)):
        by_q[:] = 0.0  # of q and of the kicked speed at this point, from what follows
        by_kicked[:] = 0.0
        on_v[b] = 0.0
        part = len(modes.instants) - 2
        for k in range(on_v.shape[1] - 1, -1, -1):
            if k <= modes.instants[part] and part > 0:
                part -= 1
            share = (k - modes.instants[part]) / (modes.instants[part + 1] - modes.instants[part])
            # kicked = speed - kick(q, speed₀) and speed = speed₀ - kick(q, speed₀), where speed₀ came of the
            # step; kicked takes the kick of both
            for i in range(n):
                by_speed[i] = on_speed[b, k, i] + by_kicked[i]
                total[i] = by_speed[i] + by_kicked[i]
            for i in range(n):
                left, right, loss = 0.0, 0.0, 0.0
                for j in range(n):
                    left += change[b, part, i, j] * total[j]
                    right += change[b, part + 1, i, j] * total[j]
                    loss += modes.damping[j, i] * total[j]
                kick[i] = modes.half * (left + share * (right - left))
                by_kicked[i] = by_speed[i] - modes.half * loss  # of speed₀
            for i in range(n):
                here = by_q[i] + on_q[b, k, i] - kick[i]
                if k == 0:
                    break
                a, back = modes.step[i], by_kicked[i]
                on_v[b, k, i] += a[0, 3] * here + a[1, 3] * back
                on_v[b, k - 1, i] += a[0, 2] * here + a[1, 2] * back
                by_q[i] = a[0, 0] * here + a[1, 0] * back
                by_kicked[i] = a[0, 1] * here + a[1, 1] * back


@compiled
def follow_all(
    targets: Array32, p_initial: Array32, low: Array32, high: Array32, step: Array32, powers: Array32
) -> None:
    """As `track_rows`, the batch last.

    Args:
        targets: (n_gen, n_knots, batch), pu; the first knot's do not matter.
        p_initial: (n_gen, batch), pu.
        low: (n_gen,), pu; likewise `high` and `step`.
        powers: receives powers, as `targets`.
    """
    for g in range(len(targets)):
        powers[g, 0] = p_initial[g]
        for j in range(1, targets.shape[1]):
            wanted, before, found = targets[g, j], powers[g, j - 1], powers[g, j]
            for b in range(len(found)):
                target = min(max(wanted[b], low[g]), high[g])
                found[b] = min(max(target, before[b] - step[g]), before[b] + step[g])


@compiled
def follow_all_adjoint(
    targets: Array32,
    powers: Array32,
    low: Array32,
    high: Array32,
    step: Array32,
    on_powers: Array32,
    on_targets: Array32,
) -> None:
    """Gradient in the targets of a function with this gradient in the powers of `follow_all`.

    Where a target lies beyond a bound, its gradient is kept if descent leads back inside.
    """
    for g in range(len(targets)):
        carry = np.zeros(targets.shape[2], np.float32)
        for j in range(targets.shape[1] - 1, 0, -1):
            for b in range(targets.shape[2]):
                wanted = targets[g, j, b]
                inside = min(max(wanted, low[g]), high[g])
                whole = on_powers[g, j, b] + carry[b]
                limited = abs(inside - powers[g, j - 1, b]) > step[g]
                carry[b] = whole if limited else np.float32(0.0)
                own = np.float32(0.0) if limited else whole
                outward = (wanted > high[g] and own < 0.0) or (wanted < low[g] and own > 0.0)
                on_targets[g, j, b] = np.float32(0.0) if outward else own
        on_targets[g, 0] = 0.0
