"""Modes as oscillators, compiled: their exact maps over a time, and those of the mean stiffness along paths.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


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
def interval_maps(step: Array, fine: int) -> Array:
    """(q, q̇, v, v⁺) of two knots to (q, q̇) at the fine points between, (fine + 1, 2, 4, n_modes)."""
    maps = np.zeros((fine + 1, 2, 4, len(step)))
    maps[0, 0, 0] = maps[0, 1, 1] = 1.0
    for i in range(fine):
        for r in range(2):
            for c in range(4):
                maps[i + 1, r, c] = step[:, r, 0] * maps[i, 0, c] + step[:, r, 1] * maps[i, 1, c]
            for c, share in ((2, 1.0 - i / fine), (3, i / fine)):
                maps[i + 1, r, c] += step[:, r, 2] * share
            for c, share in ((2, 1.0 - (i + 1) / fine), (3, (i + 1) / fine)):
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
        h: time from one fine point to the next, s.
        into: receives powers by column, (batch, n_gen, n_modes).
        maps: receives `interval_maps`, (batch, fine + 1, 2, 4, n_modes).
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
