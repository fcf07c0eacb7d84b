"""The swing equation in modal coordinates, compiled: advanced along the time grid, and its transpose."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

Array32 = NDArray[np.float32]
#: Of either precision.
Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int_]

#: For parts of a loop that a call would slow down.
inlined = numba.njit(inline="always")
#: Grid points for which C is held: it changes over many seconds.
HELD = 4


class Modes(NamedTuple):
    """The grid in modal coordinates; see `ModalGrid`."""

    step: Floats  # (q, q̇, v, v⁺) -> (q⁺, q̇⁺) of each mode, (2, 4, n_modes)
    damping: Floats  # what is left of it, for half a step, (n_modes, n_modes)
    half: float  # half the spacing of the time grid, s
    stiffness_points: Indices  # grid points at which stiffness changes are given, (n_stiffness,)


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
    maps, column, term = np.empty((len(squares), 2, 4)), np.empty(4), np.empty(4)
    for m in range(len(squares)):
        halvings = 0
        while (abs(squares[m]) * h + rate + 1.0) * h > 0.5 * 2.0**halvings:
            halvings += 1
        short, exact = h / 2.0**halvings, np.zeros((4, 4))  # of (q, q̇, v, v̇)
        for c in range(4):
            column[:], term[:] = 0.0, 0.0
            column[c] = term[c] = 1.0
            for power in range(1, 15):
                part = short / power
                fall = -(squares[m] * term[0] + rate * term[1]) + term[2]
                term[0], term[1], term[2], term[3] = part * term[1], part * fall, part * term[3], 0.0
                column += term
            exact[:, c] = column
        for _ in range(halvings):
            exact = np.dot(exact, exact)
        maps[m, :, :2] = exact[:2, :2]
        maps[m, :, 3] = exact[:2, 3] / h
        maps[m, :, 2] = exact[:2, 2] - maps[m, :, 3]
    return maps


@compiled
def swing(modes: Modes, change: Floats, v: Floats, q: Floats, speed: Floats) -> None:
    """Advance problems from one grid point to the next: q̈ + γ q̇ + λ q + δD q̇ + C(t) q = v.

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick. Both are symmetric,
    so that products add up rows.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: C linear between its points, (batch, n_stiffness, n_modes, n_modes), 1/s².
        v: inputs, (batch, n_points, n_modes).
        q: coordinates, (batch, n_points, n_modes); the first row is given.
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
    """Half a kick by C, for the grid points from k on: C in the middle of them."""
    middle, part = k + 0.5 * (HELD - 1), 0
    while part + 2 < len(modes.stiffness_points) and middle > modes.stiffness_points[part + 1]:
        part += 1
    later = (middle - modes.stiffness_points[part]) / (
        modes.stiffness_points[part + 1] - modes.stiffness_points[part]
    )
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
def swing_adjoint(modes: Modes, change: Floats, on_q: Floats, on_speed: Floats, on_v: Floats) -> None:
    """Gradient in the inputs of a function with these gradients in q and q̇; the transpose of `swing`.

    The kick by damping after a step is taken with the speed before it; C and δD are symmetric.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: see `swing`.
        on_q: (batch, n_points, n_modes).
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
