"""Angles along a path, compiled: power flow at t = 0, electrical power, stiffness, and samples of loads.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

Indices = NDArray[np.int_]

#: Mismatch of a power flow that is good enough here, pu, and the steps after which it is given up.
MISMATCH, STEPS = 1e-8, 60
#: The Jacobian is renewed where a step makes the mismatch smaller by less than this factor.
CONTRACTION = 0.3


class Lines(NamedTuple):
    """A lossless network."""

    ends: Indices  # (n_line, 2)
    coupling: Array  # (n_line,), pu
    generators: Indices  # buses, (n_gen,)
    algebraic: Indices  # load and junction buses, (n_algebraic,)
    loads: Indices  # buses, (n_load,)


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
def start_angles(
    lines: Lines, unknown: Indices, nominal: Array, inverse: Array, wanted: Array, theta: Array
) -> bool:
    """Solve the power flow of one instance by Newton's method with a kept inverse.

    Args:
        lines: the network.
        unknown: all buses but the slack, (n_unknown,).
        nominal: angles to start from, (n_bus,), rad.
        inverse: of the Jacobian there, (n_unknown, n_unknown).
        wanted: injections at all buses, (n_bus,), pu.
        theta: receives the angles, (n_bus,), rad.

    Returns:
        Whether there is a solution, a stable one.
    """
    n, f = len(unknown), np.empty(len(theta))
    off, last, kept = np.empty(n), np.inf, inverse.copy()
    theta[:] = nominal
    for _ in range(STEPS):
        _injections(lines, theta, f)
        for i in range(n):
            off[i] = f[unknown[i]] - wanted[unknown[i]]
        worst = np.abs(off).max()
        if worst < MISMATCH:
            for i in range(len(lines.coupling)):
                if abs(theta[lines.ends[i, 0]] - theta[lines.ends[i, 1]]) > 0.5 * np.pi:
                    return False
            return True
        if not worst < 1e6:
            return False
        if worst > CONTRACTION * last:
            kept[:] = np.linalg.inv(_jacobian(lines, unknown, theta))
        last = worst
        step = np.dot(kept, off)
        for i in range(n):
            theta[unknown[i]] -= step[i]
    return False


@compiled
def follow_path(
    lines: Lines,
    path: Array,
    p_load: Array,
    theta: Array,
    instants: Indices,
    f: Array,
    stiffness: Array,
) -> bool:
    """Electrical power of the generators along a path of their angles, and its derivative.

    Args:
        lines: the network.
        path: angles of the generators at the knots, (n_knots, n_gen), rad.
        p_load: load injections there, (n_knots, n_load), pu.
        theta: angles of all buses near the first ones, (n_bus,), rad.
        instants: at which knots the derivative is taken; the first knot is one, (n_instants,).
        f: receives electrical powers of the generators, (n_knots, n_gen), pu.
        stiffness: receives ∂f/∂θ of the generators, (n_instants, n_gen, n_gen), pu/rad.

    Returns:
        Whether there is a solution all along.
    """
    n, n_gen, n_bus = len(lines.algebraic), path.shape[1], len(theta)
    angle, injection, wanted = theta.copy(), np.empty(n_bus), np.zeros(n_bus)
    before, change = np.empty(n), np.zeros(n)
    for i in range(n):
        before[i] = angle[lines.algebraic[i]]
    off, inverse, at, known = np.empty(n), np.empty((n, n)), 0, False
    for k in range(len(path)):
        for g in range(n_gen):
            angle[lines.generators[g]] = path[k, g]
        for i in range(len(lines.loads)):
            wanted[lines.loads[i]] = p_load[k, i]
        for i in range(n):
            angle[lines.algebraic[i]] = before[i] + change[i]
        last = np.inf
        for step in range(STEPS):
            _injections(lines, angle, injection)
            worst = 0.0
            for i in range(n):
                off[i] = injection[lines.algebraic[i]] - wanted[lines.algebraic[i]]
                worst = max(worst, abs(off[i]))
            if worst < MISMATCH:
                break
            if not worst < 1e6 or step == STEPS - 1:
                return False
            if not known or worst > CONTRACTION * last:
                inverse[:], known = np.linalg.inv(_jacobian(lines, lines.algebraic, angle)), True
            last = worst
            correction = np.dot(inverse, off)
            for i in range(n):
                angle[lines.algebraic[i]] -= correction[i]
        for i in range(n):
            found = angle[lines.algebraic[i]]
            change[i], before[i] = found - before[i], found
        if k == 0:
            change[:] = 0.0
        for g in range(n_gen):
            f[k, g] = injection[lines.generators[g]]
        if at < len(instants) and instants[at] == k:
            _reduced(lines, angle, stiffness[at])
            at += 1
    return True


@compiled
def _injections(lines: Lines, theta: Array, f: Array) -> None:
    """f(θ) at all buses, pu."""
    f[:] = 0.0
    for i in range(len(lines.coupling)):
        near, far = lines.ends[i, 0], lines.ends[i, 1]
        flow = lines.coupling[i] * np.sin(theta[near] - theta[far])
        f[near] += flow
        f[far] -= flow


@compiled
def _jacobian(lines: Lines, buses: Indices, theta: Array) -> Array:
    """∂f/∂θ of some buses in their own angles, pu/rad."""
    place = np.full(len(theta), -1)
    for i in range(len(buses)):
        place[buses[i]] = i
    jacobian = np.zeros((len(buses), len(buses)))
    for i in range(len(lines.coupling)):
        near, far = place[lines.ends[i, 0]], place[lines.ends[i, 1]]
        slope = lines.coupling[i] * np.cos(theta[lines.ends[i, 0]] - theta[lines.ends[i, 1]])
        if near >= 0:
            jacobian[near, near] += slope
        if far >= 0:
            jacobian[far, far] += slope
        if near >= 0 and far >= 0:
            jacobian[near, far] -= slope
            jacobian[far, near] -= slope
    return jacobian


@compiled
def _reduced(lines: Lines, theta: Array, stiffness: Array) -> None:
    """∂f/∂θ of the generators where the loads fix the other angles, pu/rad."""
    n_gen, n = len(lines.generators), len(lines.algebraic)
    place, own = np.full(len(theta), -1), np.full(len(theta), -1)
    for i in range(n):
        place[lines.algebraic[i]] = i
    for g in range(n_gen):
        own[lines.generators[g]] = g
    across = np.zeros((n, n_gen))
    stiffness[:] = 0.0
    for i in range(len(lines.coupling)):
        near, far = lines.ends[i, 0], lines.ends[i, 1]
        slope = lines.coupling[i] * np.cos(theta[near] - theta[far])
        if own[near] >= 0:
            stiffness[own[near], own[near]] += slope
        if own[far] >= 0:
            stiffness[own[far], own[far]] += slope
        if own[near] >= 0 and own[far] >= 0:
            stiffness[own[near], own[far]] -= slope
            stiffness[own[far], own[near]] -= slope
        if own[near] >= 0 and place[far] >= 0:
            across[place[far], own[near]] -= slope
        if own[far] >= 0 and place[near] >= 0:
            across[place[near], own[far]] -= slope
    others = np.linalg.solve(_jacobian(lines, lines.algebraic, theta), across)
    stiffness -= np.dot(across.T, others)


@compiled
def sample_paths(segments: Array, spacing: float, values: Array) -> None:
    """Loads at the fine points; around a kink as means weighted by hat functions, which keep the area.

    Args:
        segments: (start in s, value there, slope) of each linear piece, (batch, n_load, n_segments, 3).
        spacing: of the fine points, s.
        values: receives the loads, (batch, n_fine, n_load), pu.
    """
    for b in range(len(values)):
        for i in range(values.shape[2]):
            path, last = segments[b, i], len(segments[b, i]) - 1
            at = 0
            for k in range(values.shape[1]):
                while at < last and path[at + 1, 0] <= k * spacing:
                    at += 1
                values[b, k, i] = path[at, 1] + path[at, 2] * (k * spacing - path[at, 0])
            for s in range(1, len(path)):
                start, bend = path[s, 0], path[s, 2] - path[s - 1, 2]
                before = int(start / spacing) if start < spacing * values.shape[1] else values.shape[1]
                for k in range(max(before, 1), min(before + 2, values.shape[1] - 1)):
                    u = (k * spacing - start) / spacing
                    mean = (max(u + 1.0, 0.0) ** 3 - 2.0 * max(u, 0.0) ** 3) / 6.0
                    values[b, k, i] += bend * spacing * (mean - max(u, 0.0))
