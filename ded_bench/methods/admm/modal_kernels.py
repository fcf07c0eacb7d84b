"""Modal coordinates, compiled: the swing equation along the time grid, its transpose, the quadratic model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array, Indices
from ded_bench.problem.compiled import compiled, inlined

#: Of either precision.
Floats = NDArray[np.floating[Any]]

#: Grid points for which C is held: it changes over many seconds.
HELD = 4
#: Smallest square of an angular frequency, 1/s²: what is divided by squares of it has eight digits left.
SLOWEST = 1e-4
#: `modal_change` treats so many modes at once: loops over them are vectorised if all that they need lies in
#: one array of constant shape.
LANES = 8


class Modes(NamedTuple):
    """The grid in modal coordinates; see `ModalGrid`."""

    step: Floats  # (q, q̇, v, v⁺) -> (q⁺, q̇⁺) of each mode, (2, 4, n_modes)
    damping: Floats  # what is left of it, for half a step, (n_modes, n_modes)
    half: float  # half the spacing of the time grid, s
    stiffness_points: Indices  # grid points at which stiffness changes are given, (n_stiffness,)


class MeanModes(NamedTuple):
    """Modes of the mean stiffness along trajectories of a batch, each of which moves alone."""

    powers: Array  # by column, (batch, n_gen, n_modes)
    maps: Array  # of `interval_maps`, (batch, POINTS + 1, 2, 4, n_modes)
    outputs: Array  # Σ ω² over the generators for q̇ = 1, and P_s² for q = 1, (batch, 2, n_modes)


@compiled
def oscillators(squares: Array, rate: float, h: float) -> Array:
    """Exact maps of q̈ + rate q̇ + square q = v over h, v linear: (q, q̇, v, v⁺) -> (q⁺, q̇⁺).

    Args:
        squares: of angular frequencies, (n_modes,), 1/s².
        rate: of damping, 1/s.
        h: time, s.

    Returns:
        (n_modes, 2, 4).
    """
    maps, fall = np.empty((len(squares), 2, 4)), np.exp(-0.5 * rate * h)
    for m in range(len(squares)):
        square = squares[m] if abs(squares[m]) > SLOWEST else SLOWEST
        turn = np.sqrt(square - 0.25 * rate**2 + 1e-12j)  # nearly imaginary where damping is strong; never 0
        cos, sin = fall * np.cos(turn * h).real, fall * (np.sin(turn * h) / turn).real
        maps[m, 0, 0], maps[m, 0, 1] = cos + 0.5 * rate * sin, sin
        maps[m, 1, 0], maps[m, 1, 1] = -square * sin, cos - 0.5 * rate * sin
        by_step = (1.0 - maps[m, 0, 0]) / square
        maps[m, 0, 3], maps[m, 1, 3] = (h - sin - rate * by_step) / (square * h), by_step / h
        maps[m, 0, 2], maps[m, 1, 2] = by_step - maps[m, 0, 3], sin - maps[m, 1, 3]
    return maps


@compiled
def swing(modes: Modes, change: Floats, v: Floats, q: Floats, speed: Floats) -> None:
    """Advance a problem from one grid point to the next: q̈ + γ q̇ + λ q + δD q̇ + C(t) q = v.

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick. Both are symmetric,
    so that products add up rows.

    Args:
        modes: the grid; its arrays and the others are all of one precision. Their last axis may have more
            modes, whose values are zero.
        change: C linear between its points, (n_stiffness, n_modes, n_modes), 1/s².
        v: inputs, (n_points, n_modes).
        q: coordinates, (n_points, n_modes); the first row is given.
        speed: their derivatives, likewise.
    """
    (n_points, n), step, damping = v.shape, modes.step, modes.damping
    kicked, kick, held = np.empty(n, v.dtype), np.empty(n, v.dtype), np.empty(change.shape[1:], v.dtype)
    damped, shares, loss = np.any(damping != 0.0), np.empty(2, v.dtype), np.empty(n, v.dtype)
    for k in range(n_points):
        if k % HELD == 0:
            _hold(modes, change, k, shares, held)
        if k > 0:
            for i in range(n):
                pushed = step[0, 2, i] * v[k - 1, i] + step[0, 3, i] * v[k, i]
                q[k, i] = (step[0, 0, i] * q[k - 1, i] + pushed) + step[0, 1, i] * kicked[i]
            for i in range(n):
                pushed = step[1, 2, i] * v[k - 1, i] + step[1, 3, i] * v[k, i]
                speed[k, i] = (step[1, 0, i] * q[k - 1, i] + pushed) + step[1, 1, i] * kicked[i]
        _set_product(held, q, k, kick)
        if damped:
            _set_product(damping, speed, k, loss)
            for i in range(n):
                kick[i] += loss[i]
        if k > 0:
            for i in range(n):
                kicked[i] = speed[k, i] - (kick[i] + kick[i])
            for i in range(n):
                speed[k, i] -= kick[i]
        else:
            for i in range(n):
                kicked[i] = speed[k, i] - kick[i]


@inlined
def _hold(modes: Modes, change: Floats, k: int, shares: Floats, held: Floats) -> None:
    """Half a kick by C, for the grid points from k on: C in the middle of them."""
    middle, part, points = k + 0.5 * (HELD - 1), 0, modes.stiffness_points
    while part + 2 < len(points) and middle > points[part + 1]:
        part += 1
    later = (middle - points[part]) / (points[part + 1] - points[part])
    shares[1] = modes.half * min(later, 1.0)
    shares[0] = modes.half - shares[1]
    for j in range(len(held)):
        for i in range(held.shape[1]):
            held[j, i] = shares[0] * change[part, j, i] + shares[1] * change[part + 1, j, i]


@inlined
def _set_product(matrix: Floats, rows: Floats, k: int, found: Floats) -> None:
    """A symmetric matrix times one of the rows, four columns at a time, after those that are left over."""
    n = len(matrix)
    first = n % 4
    if first == 3:
        one, two, three = rows[k, 0], rows[k, 1], rows[k, 2]
        for i in range(len(found)):
            found[i] = (one * matrix[0, i] + two * matrix[1, i]) + three * matrix[2, i]
    else:
        found[:] = 0.0
        for j in range(first):
            one = rows[k, j]
            for i in range(len(found)):
                found[i] += one * matrix[j, i]
    for j in range(first, n, 4):
        one, two, three, four = rows[k, j], rows[k, j + 1], rows[k, j + 2], rows[k, j + 3]
        for i in range(len(found)):
            found[i] += (one * matrix[j, i] + two * matrix[j + 1, i]) + (
                three * matrix[j + 2, i] + four * matrix[j + 3, i]
            )


@compiled
def swing_adjoint(modes: Modes, change: Floats, on_q: Floats, on_speed: Floats, on_v: Floats) -> None:
    """Gradient in the inputs of a function with these gradients in q and q̇; the transpose of `swing`.

    The kick by damping after a step is taken with the speed before it; C and δD are symmetric.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: see `swing`.
        on_q: (n_points, n_modes).
        on_speed: likewise.
        on_v: receives the gradient, likewise.
    """
    (n_points, n), step, damping = on_v.shape, modes.step, modes.damping
    by_q, by_speed, by_kicked = np.zeros(n, on_v.dtype), np.empty(n, on_v.dtype), np.zeros(n, on_v.dtype)
    kick, loss, both = np.empty(n, on_v.dtype), np.empty(n, on_v.dtype), np.empty((1, n), on_v.dtype)
    held, shares = np.empty(change.shape[1:], on_v.dtype), np.empty(2, on_v.dtype)
    damped = np.any(damping != 0.0)
    on_v[n_points - 1] = 0.0
    for k in range(n_points - 1, 0, -1):
        if k % HELD == HELD - 1 or k == n_points - 1:
            _hold(modes, change, k - k % HELD, shares, held)
        # kicked = speed - kick(q, speed₀) and speed = speed₀ - kick(q, speed₀), where speed₀ came of the
        # step; kicked takes the kick of both. by_q and by_kicked are of this point, from what follows
        for i in range(n):
            both[0, i] = on_speed[k, i] + (by_kicked[i] + by_kicked[i])
        for i in range(n):
            by_speed[i] = on_speed[k, i] + by_kicked[i]
        _set_product(held, both, 0, kick)
        if damped:
            _set_product(damping, both, 0, loss)
            for i in range(n):
                by_speed[i] -= loss[i]  # of speed₀
        for i in range(n):
            by_q[i] = (by_q[i] + on_q[k, i]) - kick[i]
        for i in range(n):
            on_v[k, i] += step[0, 3, i] * by_q[i] + step[1, 3, i] * by_speed[i]
        for i in range(n):
            on_v[k - 1, i] = step[0, 2, i] * by_q[i] + step[1, 2, i] * by_speed[i]
        for i in range(n):
            by_kicked[i] = step[0, 1, i] * by_q[i] + step[1, 1, i] * by_speed[i]
        for i in range(n):
            by_q[i] = step[0, 0, i] * by_q[i] + step[1, 0, i] * by_speed[i]


@compiled
def interval_maps(step: Array, points: int) -> Array:
    """(q, q̇, v, v⁺) of two knots to (q, q̇) at the grid points between.

    Args:
        step: of `oscillators`, (n_modes, 2, 4).
        points: how many grid points make an interval between knots.

    Returns:
        (points + 1, 2, 4, n_modes).
    """
    maps = np.zeros((points + 1, 2, 4, len(step)))
    for m in range(len(step)):
        maps[0, 0, 0, m] = maps[0, 1, 1, m] = 1.0
        for i in range(points):
            now, then = i / points, (i + 1) / points  # shares of v⁺ in the input
            for r in range(2):
                for c in range(4):
                    maps[i + 1, r, c, m] = step[m, r, 0] * maps[i, 0, c, m] + step[m, r, 1] * maps[i, 1, c, m]
                maps[i + 1, r, 2, m] += (1.0 - now) * step[m, r, 2] + (1.0 - then) * step[m, r, 3]
                maps[i + 1, r, 3, m] += now * step[m, r, 2] + then * step[m, r, 3]
    return maps


@compiled
def mean_modes(mean: Array, mass: Array, inertia: float, rate: float, h: float, points: int) -> MeanModes:
    """Modes of stiffnesses, in which powers weigh by the inverse of inertia.

    Args:
        mean: stiffnesses, (batch, n_gen, n_gen), pu/rad.
        mass: inertia of each generator in means of all, (n_gen,).
        inertia: its mean, s² pu/rad.
        rate: of damping, 1/s.
        h: time from one grid point to the next, s.
        points: how many of them make an interval between knots.
    """
    (batch, n, _), root, relative = mean.shape, np.sqrt(mass), np.empty(mean.shape[1:])
    powers, outputs = np.empty_like(mean), np.zeros((batch, 2, n))
    maps = np.empty((batch, points + 1, 2, 4, n))
    for b in range(batch):
        for g in range(n):
            for i in range(n):
                relative[g, i] = mean[b, g, i] / (inertia * root[g] * root[i])
        squares, u = np.linalg.eigh(relative)
        found = interval_maps(oscillators(squares, rate, h), points)
        for m in range(n):
            drawn = 0.0
            for g in range(n):
                powers[b, g, m], angle = root[g] * u[g, m], u[g, m] / root[g]
                outputs[b, 0, m] += angle**2
                for i in range(n):
                    drawn += mean[b, g, i] * angle
            outputs[b, 1, m] = drawn**2
            for i in range(points + 1):
                for r in range(2):
                    for c in range(4):
                        maps[b, i, r, c, m] = found[i, r, c, m] / (1.0 if c < 2 else inertia)
    return MeanModes(powers, maps, outputs)


@compiled
def modal_change(maps: Array, outputs: Array, weights: Array, gradient: Array, change: Array) -> None:
    """Minimise gradient · v + ½ v · A v mode by mode, by dynamic programming (a Riccati recursion).

    A weighs, with `weights`: powers v at the knots, their changes, and at the grid points ω and P_s as if
    each mode moved alone. Up to t = 0 all is 0.

    Args:
        maps: of `interval_maps`, (POINTS + 1, 2, 4, n_modes).
        outputs: Σ ω² over the generators for q̇ = 1, and P_s² for q = 1, (2, n_modes).
        weights: (4,).
        gradient: (n_knots, n_modes); the first knot's does not matter.
        change: receives v, likewise; 0 at the first knot.
    """
    n, n_modes = gradient.shape
    s = np.empty((35, LANES))
    to_q, to_speed = s[0:4], s[4:8]  # (q, q̇, v, v⁺) of a knot to (q⁺, q̇⁺) of the next
    stage = s[8:18]  # weights of an interval, upper triangle of a 4 × 4 matrix, row by row
    value, linear = s[18:24], s[24:27]  # cost to go, in (q, q̇, v): upper triangle of 3 × 3, linear part
    gain, pull, state = s[27:31], s[31], s[32:35]  # v⁺ = -gain[:3] (q, q̇, v) - gain[3]; gradient; (q, q̇, v)
    gains = np.empty((n - 1, 4, LANES))
    for first in range(0, n_modes, LANES):
        used = min(LANES, n_modes - first)
        s[:] = 0.0
        _weigh_interval(maps, outputs, weights, first, to_q, to_speed, stage)
        for k in range(n - 2, -1, -1):
            for m in range(used):
                pull[m] = gradient[k + 1, first + m]
            for m in range(LANES):
                a0, a1, a2, a3 = to_q[0, m], to_q[1, m], to_q[2, m], to_q[3, m]
                b0, b1, b2, b3 = to_speed[0, m], to_speed[1, m], to_speed[2, m], to_speed[3, m]
                v00, v01, v02 = value[0, m], value[1, m], value[2, m]
                v11, v12, v22 = value[3, m], value[4, m], value[5, m]
                l0, l1, l2 = linear[0, m], linear[1, m], linear[2, m]
                # rows of q and q̇ of the value after the interval, times the map to (q⁺, q̇⁺, v⁺)
                q0, s0 = v00 * a0 + v01 * b0, v01 * a0 + v11 * b0
                q1, s1 = v00 * a1 + v01 * b1, v01 * a1 + v11 * b1
                q2, s2 = v00 * a2 + v01 * b2, v01 * a2 + v11 * b2
                q3, s3 = v00 * a3 + v01 * b3 + v02, v01 * a3 + v11 * b3 + v12
                own = np.divide(1.0, stage[9, m] + a3 * q3 + b3 * s3 + v02 * a3 + v12 * b3 + v22)
                u0 = stage[3, m] + a0 * q3 + b0 * s3
                u1 = stage[6, m] + a1 * q3 + b1 * s3
                u2 = stage[8, m] + a2 * q3 + b2 * s3
                g0, g1, g2 = u0 * own, u1 * own, u2 * own
                force = a3 * l0 + b3 * l1 + l2 + pull[m]
                gain[0, m], gain[1, m], gain[2, m], gain[3, m] = g0, g1, g2, force * own
                value[0, m] = stage[0, m] + a0 * q0 + b0 * s0 - u0 * g0
                value[1, m] = stage[1, m] + a0 * q1 + b0 * s1 - u0 * g1
                value[2, m] = stage[2, m] + a0 * q2 + b0 * s2 - u0 * g2
                value[3, m] = stage[4, m] + a1 * q1 + b1 * s1 - u1 * g1
                value[4, m] = stage[5, m] + a1 * q2 + b1 * s2 - u1 * g2
                value[5, m] = stage[7, m] + a2 * q2 + b2 * s2 - u2 * g2
                linear[0, m] = a0 * l0 + b0 * l1 - g0 * force
                linear[1, m] = a1 * l0 + b1 * l1 - g1 * force
                linear[2, m] = a2 * l0 + b2 * l1 - g2 * force
            for r in range(4):
                for m in range(LANES):
                    gains[k, r, m] = gain[r, m]
        _roll_out(gains, to_q, to_speed, state, change, first)


@compiled
def _weigh_interval(
    maps: Array, outputs: Array, weights: Array, first: int, to_q: Array, to_speed: Array, stage: Array
) -> None:
    """The map of an interval and its weights, of LANES modes from the first on; see `modal_change`."""
    for m in range(min(LANES, maps.shape[3] - first)):
        mode, at = first + m, 0
        for r in range(4):
            to_q[r, m], to_speed[r, m] = maps[-1, 0, r, mode], maps[-1, 1, r, mode]
            for c in range(r, 4):
                for i in range(1, len(maps)):
                    on_speed, on_q = weights[2] * outputs[0, mode], weights[3] * outputs[1, mode]
                    stage[at, m] += on_speed * maps[i, 1, r, mode] * maps[i, 1, c, mode]
                    stage[at, m] += on_q * maps[i, 0, r, mode] * maps[i, 0, c, mode]
                at += 1
    for m in range(LANES):
        stage[7, m] += weights[1]
        stage[8, m] -= weights[1]
        stage[9, m] += weights[1] + weights[0]


@compiled
def _roll_out(gains: Array, to_q: Array, to_speed: Array, state: Array, change: Array, first: int) -> None:
    """Follow the gains from knot to knot; `change` receives v of LANES modes from the first on."""
    gain, used = np.empty((4, LANES)), min(LANES, change.shape[1] - first)
    change[0, first : first + used] = 0.0
    for k in range(len(gains)):
        for r in range(4):
            for m in range(LANES):
                gain[r, m] = gains[k, r, m]
        for m in range(LANES):
            q, speed, before = state[0, m], state[1, m], state[2, m]
            v = -(gain[0, m] * q + gain[1, m] * speed + gain[2, m] * before) - gain[3, m]
            state[0, m] = to_q[0, m] * q + to_q[1, m] * speed + to_q[2, m] * before + to_q[3, m] * v
            state[1, m] = (
                to_speed[0, m] * q + to_speed[1, m] * speed + to_speed[2, m] * before + to_speed[3, m] * v
            )
            state[2, m] = v
        for m in range(used):
            change[k + 1, first + m] = state[2, m]
