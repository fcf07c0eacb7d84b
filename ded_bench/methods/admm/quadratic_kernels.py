"""The quadratic model of an iteration, compiled: modes of the mean stiffness, each minimised on its own."""

from __future__ import annotations

import numpy as np

from ded_bench.methods.admm.modal_kernels import oscillators
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

#: `modal_change` treats so many modes at once: loops over them are vectorised if all that they need lies in
#: one array of constant shape.
LANES = 8


@compiled
def interval_maps(step: Array, points: int) -> Array:
    """(q, q̇, v, v⁺) of two knots to (q, q̇) at the grid points between, (POINTS + 1, 2, 4, n_modes)."""
    maps = np.zeros((points + 1, 2, 4, len(step)))
    maps[0, 0, 0] = maps[0, 1, 1] = 1.0
    for i in range(points):
        for r in range(2):
            for c in range(4):
                maps[i + 1, r, c] = step[:, r, 0] * maps[i, 0, c] + step[:, r, 1] * maps[i, 1, c]
            for c, share in ((2, 1.0 - i / points), (3, i / points)):
                maps[i + 1, r, c] += step[:, r, 2] * share
            for c, share in ((2, 1.0 - (i + 1) / points), (3, (i + 1) / points)):
                maps[i + 1, r, c] += step[:, r, 3] * share
    return maps


@compiled
def mean_modes(
    mean: Array, mass: Array, inertia: float, rate: float, h: float, into: Array, maps: Array, outputs: Array
) -> None:
    """Modes of stiffnesses, in which powers weigh by the inverse of inertia.

    Args:
        mean: stiffnesses, (batch, n_gen, n_gen), pu/rad.
        mass: inertia of each generator in means of all, (n_gen,).
        inertia: its mean, s² pu/rad.
        rate: of damping, 1/s.
        h: time from one grid point to the next, s.
        into: receives powers by column, (batch, n_gen, n_modes).
        maps: receives `interval_maps`, (batch, POINTS + 1, 2, 4, n_modes).
        outputs: receives Σ ω² over the generators for q̇ = 1, and P_s² for q = 1, (batch, 2, n_modes).
    """
    root, n = np.sqrt(mass), len(mass)
    for b in range(len(mean)):
        squares, u = np.linalg.eigh(mean[b] / np.outer(root, root))
        maps[b] = interval_maps(oscillators(squares / inertia, rate, h), maps.shape[1] - 1)
        maps[b, :, :, 2:] /= inertia
        for m in range(n):
            speeds, slack = 0.0, 0.0
            for g in range(n):
                into[b, g, m] = root[g] * u[g, m]
                speeds += (u[g, m] / root[g]) ** 2
                slack += mean[b, g].sum() * u[g, m] / root[g]
            outputs[b, 0, m], outputs[b, 1, m] = speeds, slack**2


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
        for m in range(used):
            mode, at = first + m, 0
            for r in range(4):
                to_q[r, m], to_speed[r, m] = maps[-1, 0, r, mode], maps[-1, 1, r, mode]
                for c in range(r, 4):
                    for i in range(1, len(maps)):
                        on_speed, on_q = weights[2] * outputs[0, mode], weights[3] * outputs[1, mode]
                        stage[at, m] += on_speed * maps[i, 1, r, mode] * maps[i, 1, c, mode]
                        stage[at, m] += on_q * maps[i, 0, r, mode] * maps[i, 0, c, mode]
                    at += 1
        stage[7] += weights[1]
        stage[8] -= weights[1]
        stage[9] += weights[1] + weights[0]
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
        change[0, first : first + used] = 0.0
        for k in range(n - 1):
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


@compiled
def modal_products(maps: Array, outputs: Array, one: Array, other: Array, found: Array) -> None:
    """One · A_i other for the parts A_i of the matrix of `modal_change`, one for each weight.

    Args:
        maps: of the mean modes, (batch, POINTS + 1, 2, 4, n_modes).
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
