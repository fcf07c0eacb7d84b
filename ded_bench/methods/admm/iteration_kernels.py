"""All that Numba compiles of the policy itself: the grid's response and its transpose, and the iterations.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

import numba
import numpy as np

from ded_bench.methods.admm.iteration_records import (
    DOUBLING,
    PRICE,
    STRAIGHT,
    Array32,
    Floats,
    Given,
    Limits,
    Modes,
)
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

inlined = numba.njit(inline="always")

#: Fine points for which C is held: it changes over many seconds.
HELD = 4
#: `modal_change` treats so many modes at once, each in a column of an array of constant shape, without which
#: loops over modes are not vectorised. First rows of: maps to q and q̇; the quadratic form of an interval and
#: the value function, upper triangles; the linear part of the latter; the gradient; gains; and (q, q̇, v).
LANES = 8
MAP, STAGE, VALUE, LINEAR, FORCE, GAIN, STATE, ROWS = 0, 8, 18, 24, 27, 28, 32, 35


@compiled
def swing(modes: Modes, change: Floats, v: Floats, q: Floats, speed: Floats) -> None:
    """Advance problems from one fine point to the next: q̈ + γ q̇ + λ q + δD q̇ + C(t) q = v.

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick. Both are symmetric,
    so that products add up rows.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: C at the instants, linear between, (batch, n_instants, n_modes, n_modes), 1/s².
        v: inputs, (batch, n_fine, n_modes).
        q: coordinates, (batch, n_fine, n_modes); the first row is given.
        speed: their derivatives, likewise.
    """
    n, step, damping = v.shape[2], modes.step, modes.damping
    kicked, kick, held = np.empty(n, v.dtype), np.empty(n, v.dtype), np.empty((n, n), v.dtype)
    damped, shares = np.any(damping != 0.0), np.empty(2, v.dtype)
    for b in range(len(v)):
        for k in range(v.shape[1]):
            if k % HELD == 0:
                _hold(modes, change, b, k, shares, held)
            if k > 0:
                for i in range(n):
                    q[b, k, i] = (
                        step[0, 0, i] * q[b, k - 1, i]
                        + step[0, 1, i] * kicked[i]
                        + step[0, 2, i] * v[b, k - 1, i]
                        + step[0, 3, i] * v[b, k, i]
                    )
                for i in range(n):
                    speed[b, k, i] = (
                        step[1, 0, i] * q[b, k - 1, i]
                        + step[1, 1, i] * kicked[i]
                        + step[1, 2, i] * v[b, k - 1, i]
                        + step[1, 3, i] * v[b, k, i]
                    )
            kick[:] = 0.0
            _add_product(held, q, b, k, kick)
            if damped:
                _add_product(damping, speed, b, k, kick)
            if k > 0:
                for i in range(n):
                    speed[b, k, i] -= kick[i]
            for i in range(n):
                kicked[i] = speed[b, k, i] - kick[i]


@inlined
def _hold(modes: Modes, change: Floats, b: int, k: int, shares: Floats, held: Floats) -> None:
    """Half a kick by C, for the fine points from k on: C in the middle of them."""
    middle, part = k + 0.5 * (HELD - 1), 0
    while part + 2 < len(modes.instants) and middle > modes.instants[part + 1]:
        part += 1
    later = (middle - modes.instants[part]) / (modes.instants[part + 1] - modes.instants[part])
    shares[1] = modes.half * min(later, 1.0)
    shares[0] = modes.half - shares[1]
    for j in range(len(held)):
        for i in range(len(held)):
            held[j, i] = shares[0] * change[b, part, j, i] + shares[1] * change[b, part + 1, j, i]


@inlined
def _add_product(matrix: Floats, rows: Floats, b: int, k: int, found: Floats) -> None:
    """Add a symmetric matrix times one of the rows, four columns at a time."""
    n = len(found)
    whole = n - n % 4
    for j in range(0, whole, 4):
        one, two, three, four = rows[b, k, j], rows[b, k, j + 1], rows[b, k, j + 2], rows[b, k, j + 3]
        for i in range(n):
            found[i] += (
                one * matrix[j, i]
                + two * matrix[j + 1, i]
                + three * matrix[j + 2, i]
                + four * matrix[j + 3, i]
            )
    for j in range(whole, n):
        one = rows[b, k, j]
        for i in range(n):
            found[i] += one * matrix[j, i]


@compiled
def track_rows(targets: Array, low: Array, high: Array, step: Array) -> None:
    """Follow targets within bounds and ramps, in place.

    Args:
        targets: of several schedules, (batch, n_knots, n_gen), pu; the first knot's are P_0.
        low: (n_gen,), pu; likewise `high`.
        step: largest change between two knots, (n_gen,), pu.
    """
    for b in range(len(targets)):
        for j in range(1, targets.shape[1]):
            for g in range(targets.shape[2]):
                before = targets[b, j - 1, g]
                target = min(max(targets[b, j, g], low[g]), high[g])
                targets[b, j, g] = min(max(target, before - step[g]), before + step[g])


@compiled
def swing_adjoint(modes: Modes, change: Floats, on_q: Floats, on_speed: Floats, on_v: Floats) -> None:
    """Gradient in the inputs of a function with these gradients in q and q̇; the transpose of `swing`.

    The kick by damping after a step is taken with the speed before it; C and δD are symmetric.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: see `swing`.
        on_q: (batch, n_fine, n_modes).
        on_speed: likewise.
        on_v: receives the gradient, likewise.
    """
    n, step, damping = on_v.shape[2], modes.step, modes.damping
    by_q, by_speed, by_kicked = np.empty(n, on_v.dtype), np.empty(n, on_v.dtype), np.empty(n, on_v.dtype)
    kick, loss, held = np.empty(n, on_v.dtype), np.zeros(n, on_v.dtype), np.empty((n, n), on_v.dtype)
    both, shares, damped = np.empty((1, 1, n), on_v.dtype), np.empty(2, on_v.dtype), np.any(damping != 0.0)
    for b in range(len(on_v)):
        by_q[:] = 0.0  # of q and of the kicked speed at this point, from what follows
        by_kicked[:] = 0.0
        on_v[b] = 0.0
        for k in range(on_v.shape[1] - 1, 0, -1):
            if k % HELD == HELD - 1 or k == on_v.shape[1] - 1:
                _hold(modes, change, b, k - k % HELD, shares, held)
            # kicked = speed - kick(q, speed₀) and speed = speed₀ - kick(q, speed₀), where speed₀ came of the
            # step; kicked takes the kick of both
            for i in range(n):
                by_speed[i] = on_speed[b, k, i] + by_kicked[i]
                both[0, 0, i] = by_speed[i] + by_kicked[i]
            kick[:] = 0.0
            _add_product(held, both, 0, 0, kick)
            if damped:
                loss[:] = 0.0
                _add_product(damping, both, 0, 0, loss)
            for i in range(n):
                by_q[i] += on_q[b, k, i] - kick[i]
                by_speed[i] -= loss[i]  # of speed₀
            for i in range(n):
                on_v[b, k, i] += step[0, 3, i] * by_q[i] + step[1, 3, i] * by_speed[i]
                on_v[b, k - 1, i] = step[0, 2, i] * by_q[i] + step[1, 2, i] * by_speed[i]
            for i in range(n):
                by_kicked[i] = step[0, 1, i] * by_q[i] + step[1, 1, i] * by_speed[i]
                by_q[i] = step[0, 0, i] * by_q[i] + step[1, 0, i] * by_speed[i]


@compiled
def answer(powers: Array, given: Given, limits: Limits, modes: Modes, settings: Array) -> None:
    """Turn first schedules into answers by iterations of ADMM; see `unrolled_inference`.

    An answer is the last schedule within its limits, or the first if that is better.

    Args:
        powers: (batch, n_knots, n_gen), pu; receives the answers.
        given: the problems.
        limits: of the case.
        modes: of the case.
        settings: of each iteration, (n_iterations, 8); the columns are those of `SETTINGS`.
    """
    batch, n, n_gen = powers.shape
    n_fine = given.offset.shape[1]
    omega, p_slack = np.empty((n_fine, n_gen), np.float32), np.empty(n_fine, np.float32)
    p, gradient = np.empty((n, n_gen)), np.empty((n, n_gen))
    # copies and duals
    bounded, moved = np.empty((2, n, n_gen)), np.empty((2, n, n_gen))
    speeds, slack = np.empty((2, n_fine, n_gen), np.float32), np.empty((2, n_fine))
    for b in range(batch):
        p[:] = powers[b]
        _respond(p, given, b, limits, modes, omega, p_slack)
        first = _loss(p, omega, p_slack, given, b, limits, modes)
        bounded[0], speeds[0], slack[0] = p, omega, p_slack
        moved[0, 0], moved[0, 1:] = 0.0, p[1:] - p[:-1]
        bounded[1], moved[1], speeds[1], slack[1] = 0.0, 0.0, 0.0, 0.0
        for i in range(len(settings)):
            if i > 0:
                _respond(p, given, b, limits, modes, omega, p_slack)
            _project_powers(p, given.cost[b], limits, settings[i], bounded, moved, gradient)
            _project_response(
                (omega, p_slack), (speeds, slack), given, b, limits, modes, settings[i], gradient
            )
            _improve(p, gradient, given, b, limits, settings[i])
        track_rows(p.reshape(1, n, n_gen), limits.low, limits.high, limits.step)
        _respond(p, given, b, limits, modes, omega, p_slack)
        if _loss(p, omega, p_slack, given, b, limits, modes) <= first:
            powers[b] = p


@compiled
def _project_powers(
    p: Array, cost: Array, limits: Limits, setting: Array, bounded: Array, moved: Array, gradient: Array
) -> None:
    """Copies and duals of powers and their changes; `gradient` receives that of cost and both, in powers."""
    (n, n_gen), relaxed = p.shape, setting[6]
    unit = limits.mass * limits.unit**2
    on_powers, on_moves = setting[0] / unit, setting[1] / unit
    per_powers, per_moves = 1.0 / on_powers, 1.0 / on_moves
    gradient[0] = 0.0
    for j in range(1, n):
        share = (0.5 if j == n - 1 else 1.0) / (n - 1)
        for g in range(n_gen):
            weight = on_powers[g]
            wanted = relaxed * p[j, g] + (1.0 - relaxed) * bounded[0, j, g] + bounded[1, j, g] * per_powers[g]
            kept = min(max(wanted, limits.low[g]), limits.high[g])
            bounded[0, j, g], bounded[1, j, g] = kept, weight * (wanted - kept)
            gradient[j, g] = share * cost[1 + g] + bounded[1, j, g] + weight * (p[j, g] - kept)
            weight = on_moves[g]
            change = p[j, g] - p[j - 1, g]
            wanted = relaxed * change + (1.0 - relaxed) * moved[0, j, g] + moved[1, j, g] * per_moves[g]
            kept = min(max(wanted, -limits.step[g]), limits.step[g])
            moved[0, j, g], moved[1, j, g] = kept, weight * (wanted - kept)
            force = moved[1, j, g] + weight * (change - kept)
            gradient[j, g] += force
            gradient[j - 1, g] -= force


@compiled
def _project_response(
    outcome: tuple[Array32, Array32],
    copies: tuple[Array32, Array],
    given: Given,
    b: int,
    limits: Limits,
    modes: Modes,
    setting: Array,
    gradient: Array,
) -> None:
    """Copies and duals of ω and P_s; what they ask of powers is added to the gradient."""
    omega, p_slack = outcome
    speeds, slack = copies
    (n_fine, n_gen), n, fine = omega.shape, len(gradient), (len(omega) - 1) // (len(gradient) - 1)
    relaxed, tight = np.float32(setting[6]), np.float32(limits.bound * (1.0 - setting[7]))
    weight = np.float32(setting[2] / (limits.bound**2 * fine))
    per_weight = np.float32(1.0) / weight
    on_omega, on_v = np.empty((n_fine, n_gen), np.float32), np.empty((1, n_fine, n_gen), np.float32)
    on_q, on_speed = np.empty_like(on_v), np.empty_like(on_v)
    heavy, other = setting[3] / (limits.unit**2 * fine), np.float32(1.0) - relaxed
    price, per_heavy = given.cost[b, 0] / heavy / (n_fine - 1), 1.0 / heavy
    for k in range(n_fine):
        for g in range(n_gen):
            here = omega[k, g]
            wanted = relaxed * here + other * speeds[0, k, g] + speeds[1, k, g] * per_weight
            kept = min(max(wanted, -tight), tight)
            speeds[0, k, g], speeds[1, k, g] = kept, weight * (wanted - kept)
            on_omega[k, g] = speeds[1, k, g] + weight * (here - kept)
        own = 0.5 * price if k == 0 or k == n_fine - 1 else price
        drawn = setting[6] * p_slack[k] + (1.0 - setting[6]) * slack[0, k] + slack[1, k] * per_heavy
        least = max(drawn - own, 0.0) + min(drawn + own, 0.0)
        slack[0, k], slack[1, k] = least, heavy * (drawn - least)
        force = np.float32(slack[1, k] + heavy * (p_slack[k] - least))
        for m in range(n_gen):
            on_q[0, k, m] = -force * given.leverage[b, k, m]
    np.dot(on_omega, limits.shape.T, on_speed[0])
    swing_adjoint(modes, given.change[b : b + 1], on_q, on_speed, on_v)
    on_knots = np.zeros((n, n_gen), np.float32)
    for j in range(n - 1):
        for i in range(fine):
            later = np.float32(i / fine)
            for m in range(n_gen):
                on_knots[j, m] += (np.float32(1.0) - later) * on_v[0, j * fine + i, m]
                on_knots[j + 1, m] += later * on_v[0, j * fine + i, m]
    on_knots[n - 1] += on_v[0, n_fine - 1]
    gradient += np.dot(on_knots, limits.gain.T)


@compiled
def _improve(p: Array, gradient: Array, given: Given, b: int, limits: Limits, setting: Array) -> None:
    """Minimise the quadratic model around a schedule, in the modes of the mean stiffness."""
    fine = (given.offset.shape[1] - 1) // (len(p) - 1)
    per_unit = 1.0 / limits.unit**2
    weights = np.empty(4)
    weights[0], weights[1] = setting[0] * per_unit, setting[1] * per_unit
    weights[2] = setting[2] * setting[4] / (limits.bound**2 * fine)
    weights[3] = setting[3] * setting[5] * per_unit / fine
    modes, change = given.mean_modes[b], np.empty_like(p)
    modal = np.dot(gradient, modes)
    modal_change(given.mean_maps[b], given.mean_outputs[b], weights, modal, change)
    p += np.dot(change, modes.T)


@compiled
def modal_change(maps: Array, outputs: Array, weights: Array, gradient: Array, change: Array) -> None:
    """Minimise gradient · v + ½ v · A v mode by mode, by dynamic programming (a Riccati recursion).

    A weighs, with `weights`: powers v at the knots, their changes, and at the fine points ω and P_s as if
    each mode moved alone. Up to t = 0 all is 0.

    Args:
        maps: of `interval_maps`, (fine + 1, 2, 4, n_modes).
        outputs: Σ ω² over the generators for q̇ = 1, and P_s² for q = 1, (2, n_modes).
        weights: (4,).
        gradient: (n_knots, n_modes); the first knot's does not matter.
        change: receives v, likewise; 0 at the first knot.
    """
    n, n_modes = gradient.shape
    s = np.empty((ROWS, LANES))
    gains = np.empty((n - 1, 4, LANES))
    for first in range(0, n_modes, LANES):
        used = min(LANES, n_modes - first)
        s[:] = 0.0
        for m in range(used):
            _load_mode(maps, outputs, weights, first + m, m, s)
        s[STAGE + 7] += weights[1]
        s[STAGE + 8] -= weights[1]
        s[STAGE + 9] += weights[1] + weights[0]
        for k in range(n - 2, -1, -1):
            for m in range(used):
                s[FORCE, m] = gradient[k + 1, first + m]
            for m in range(LANES):
                a0, a1, a2, a3 = s[MAP, m], s[MAP + 1, m], s[MAP + 2, m], s[MAP + 3, m]
                b0, b1, b2, b3 = s[MAP + 4, m], s[MAP + 5, m], s[MAP + 6, m], s[MAP + 7, m]
                v00, v01, v02 = s[VALUE, m], s[VALUE + 1, m], s[VALUE + 2, m]
                v11, v12, v22 = s[VALUE + 3, m], s[VALUE + 4, m], s[VALUE + 5, m]
                l0, l1, l2 = s[LINEAR, m], s[LINEAR + 1, m], s[LINEAR + 2, m]
                # rows of q and q̇ of the value after the interval, times the map to (q⁺, q̇⁺, v⁺)
                q0, s0 = v00 * a0 + v01 * b0, v01 * a0 + v11 * b0
                q1, s1 = v00 * a1 + v01 * b1, v01 * a1 + v11 * b1
                q2, s2 = v00 * a2 + v01 * b2, v01 * a2 + v11 * b2
                q3, s3 = v00 * a3 + v01 * b3 + v02, v01 * a3 + v11 * b3 + v12
                own = np.divide(1.0, s[STAGE + 9, m] + a3 * q3 + b3 * s3 + v02 * a3 + v12 * b3 + v22)
                u0 = s[STAGE + 3, m] + a0 * q3 + b0 * s3
                u1 = s[STAGE + 6, m] + a1 * q3 + b1 * s3
                u2 = s[STAGE + 8, m] + a2 * q3 + b2 * s3
                g0, g1, g2 = u0 * own, u1 * own, u2 * own
                force = a3 * l0 + b3 * l1 + l2 + s[FORCE, m]
                s[GAIN, m], s[GAIN + 1, m], s[GAIN + 2, m], s[GAIN + 3, m] = g0, g1, g2, force * own
                s[VALUE, m] = s[STAGE, m] + a0 * q0 + b0 * s0 - u0 * g0
                s[VALUE + 1, m] = s[STAGE + 1, m] + a0 * q1 + b0 * s1 - u0 * g1
                s[VALUE + 2, m] = s[STAGE + 2, m] + a0 * q2 + b0 * s2 - u0 * g2
                s[VALUE + 3, m] = s[STAGE + 4, m] + a1 * q1 + b1 * s1 - u1 * g1
                s[VALUE + 4, m] = s[STAGE + 5, m] + a1 * q2 + b1 * s2 - u1 * g2
                s[VALUE + 5, m] = s[STAGE + 7, m] + a2 * q2 + b2 * s2 - u2 * g2
                s[LINEAR, m] = a0 * l0 + b0 * l1 - g0 * force
                s[LINEAR + 1, m] = a1 * l0 + b1 * l1 - g1 * force
                s[LINEAR + 2, m] = a2 * l0 + b2 * l1 - g2 * force
            for r in range(4):
                for m in range(LANES):
                    gains[k, r, m] = s[GAIN + r, m]
        change[0, first : first + used] = 0.0
        for k in range(n - 1):
            for r in range(4):
                for m in range(LANES):
                    s[GAIN + r, m] = gains[k, r, m]
            for m in range(LANES):
                q, speed, before = s[STATE, m], s[STATE + 1, m], s[STATE + 2, m]
                v = -(s[GAIN, m] * q + s[GAIN + 1, m] * speed + s[GAIN + 2, m] * before) - s[GAIN + 3, m]
                s[STATE, m] = (
                    s[MAP, m] * q + s[MAP + 1, m] * speed + s[MAP + 2, m] * before + s[MAP + 3, m] * v
                )
                s[STATE + 1, m] = (
                    s[MAP + 4, m] * q + s[MAP + 5, m] * speed + s[MAP + 6, m] * before + s[MAP + 7, m] * v
                )
                s[STATE + 2, m] = v
            for m in range(used):
                change[k + 1, first + m] = s[STATE + 2, m]


@inlined
def _load_mode(maps: Array, outputs: Array, weights: Array, mode: int, m: int, s: Array) -> None:
    """Write one mode's map over an interval, and what ω and P_s weigh there, to a lane of `modal_change`."""
    at = STAGE
    for r in range(4):
        s[MAP + r, m], s[MAP + 4 + r, m] = maps[-1, 0, r, mode], maps[-1, 1, r, mode]
        for c in range(r, 4):
            for i in range(1, len(maps)):
                s[at, m] += weights[2] * outputs[0, mode] * maps[i, 1, r, mode] * maps[i, 1, c, mode]
                s[at, m] += weights[3] * outputs[1, mode] * maps[i, 0, r, mode] * maps[i, 0, c, mode]
            at += 1


@compiled
def _loss(
    p: Array, omega: Array32, p_slack: Array32, given: Given, b: int, limits: Limits, modes: Modes
) -> float:
    """Cost as a part of `Outset.scale`, and the penalty; see `ScheduleLoss`."""
    cost, penalty, (n, n_gen), n_fine = 0.0, 0.0, p.shape, len(p_slack)
    for j in range(n):
        for g in range(n_gen):
            share = 0.5 if j == 0 or j == n - 1 else 1.0
            cost += share * given.cost[b, 1 + g] * p[j, g] / (n - 1)
    for k in range(n_fine):
        share = 0.5 if k == 0 or k == n_fine - 1 else 1.0
        cost += share * given.cost[b, 0] * abs(p_slack[k]) / (n_fine - 1)
        for g in range(n_gen):
            if abs(omega[k, g]) > limits.bound:
                excess = abs(omega[k, g]) / limits.bound - 1.0
                bent = min(excess, STRAIGHT)
                penalty += excess + (excess - 0.5 * bent) * bent / DOUBLING
    return float(cost + PRICE * penalty * 2.0 * modes.half)


@compiled
def _respond(
    powers: Array, given: Given, b: int, limits: Limits, modes: Modes, omega: Array32, p_slack: Array32
) -> None:
    """What a schedule does: ω (n_fine, n_gen) and P_s (n_fine,); see `PathModel.respond`."""
    (n, n_gen), n_fine = powers.shape, len(p_slack)
    fine, force = (n_fine - 1) // (n - 1), np.empty((1, n_fine, n_gen), np.float32)
    q, speed = np.empty_like(force), np.empty_like(force)
    at_knots = np.dot(powers.astype(np.float32), limits.gain)
    force[0] = given.offset[b]
    for j in range(n - 1):
        for i in range(fine):
            later = np.float32(i / fine)
            for m in range(n_gen):
                here = at_knots[j, m] + later * (at_knots[j + 1, m] - at_knots[j, m])
                force[0, j * fine + i, m] += here
    force[0, n_fine - 1] += at_knots[n - 1]
    q[0, 0], speed[0, 0] = given.state[b, 0], given.state[b, 1]
    swing(modes, given.change[b : b + 1], force, q, speed)
    np.dot(speed[0], limits.shape, omega)
    for k in range(n_fine):
        drawn = given.slack[b, k]
        for m in range(n_gen):
            drawn -= given.leverage[b, k, m] * q[0, k, m]
        p_slack[k] = drawn
