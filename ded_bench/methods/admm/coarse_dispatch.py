"""First schedules of `ded-admm`: the cheapest dispatch whose angles turn no faster than the bound on |ω|.

Without inertia, generators deliver P = P_0 + T (L - L_0) + S x at once, x being how far their angles are from
those at t = 0. With x linear between knots a few seconds apart, the dispatch is a small program

    min Σ_j w_j (c · P_j + c_s |P_s|_j)   with P_j, P_{j+1} - P_j and x_{j+1} - x_j within limits.

Iterations of the alternating direction method of multipliers (Boyd et al. 2011) solve it roughly, from the
merit order. The matrix of their quadratic program is always the same: it falls apart into one for each
eigenvector of DᵀD, where D takes differences in time, and these are inverted once for a case.

Where the bound is loose, ramps shape schedules: a merit order within ramps, at all knots, is as cheap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Indices, largest_divisor

#: A bound is loose if a generator that ramps alone, at its limit, turns at less than this part of it.
RAMPING = 0.1
#: Coarse knots are at most so far apart, s, but for knots farther apart.
APART_S = 4.0
#: Part of the bound on |ω| at which angles turn: the rest is left to oscillations.
RATE = 0.9
#: Iterations; penalties of turns, powers, ramps and P_s; relaxation (see studies/admm.md).
ITERATIONS, PENALTIES, RELAXATION = 40, (5.5, 4.0, 5.0, 5.7), 1.35


class CoarseGrid(NamedTuple):
    """What the program has of a case, on n intervals between coarse knots."""

    every: int  # knots from one coarse knot to the next
    is_tight: bool  # the bound
    stiffness: Array  # S, (n_gen, n_gen), pu/rad
    compliance: Array  # its inverse
    low: Array  # of powers, (n_gen,), pu
    high: Array
    ramp: Array  # largest change of powers over an interval, (n_gen,), pu
    turn: float  # largest change of angles, rad
    penalties: Array  # of turns (1/rad²), powers, ramps and P_s (1/pu²), (4,)
    waves: Array  # eigenvectors of DᵀD by column, (n, n)
    inverses: Array  # of the quadratic program, for each of them, (n, n_gen, n_gen)


def coarse_grid(case: Case, knots: Array, bound: float, stiffness: Array, compliance: Array) -> CoarseGrid:
    """The program of a case.

    Args:
        case: gives limits of powers.
        knots: of schedules, (n_knots,), s.
        bound: of |ω|, rad/s.
        stiffness: S, (n_gen, n_gen), pu/rad.
        compliance: its inverse.
    """
    is_tight = bool(np.median(case.ramp / np.diag(stiffness)) >= RAMPING * bound)
    every = largest_divisor(len(knots) - 1, APART_S / float(knots[1])) if is_tight else 1
    n, apart_s = (len(knots) - 1) // every, every * float(knots[1])
    turn = RATE * bound * apart_s
    unit = float(np.exp(np.log(np.diag(stiffness) * turn).mean()))  # pu
    # one pu at one coarse knot, as a part of what all generators can give at all of them
    price = 1.0 / (n * np.maximum(np.abs(case.p_min), np.abs(case.p_max)).sum())
    penalties = price / unit * np.array(PENALTIES) * [(unit / turn) ** 2, 1.0, 1.0, 1.0]
    squares, waves = np.linalg.eigh(np.diag([2.0] * (n - 1) + [1.0]) - np.eye(n, k=1) - np.eye(n, k=-1))
    on_turns, on_powers, on_ramps, on_slack = penalties
    same = stiffness @ (on_powers * np.eye(len(stiffness)) + on_slack) @ stiffness
    differences = on_turns * np.eye(len(stiffness)) + on_ramps * stiffness @ stiffness
    inverses = np.linalg.inv(same + squares[:, None, None] * differences)
    given = every, is_tight, stiffness, compliance, case.p_min, case.p_max, case.ramp * apart_s
    return CoarseGrid(*given, turn, penalties, waves, inverses)


@compiled
def dispatch_angles(
    grid: CoarseGrid, base: Array, demand: Array, cost: Array, order: Indices, scale: Array
) -> Array:
    """Angles of the cheapest dispatch.

    Args:
        grid: the program.
        base: P_0 + T (L - L_0) at the coarse knots, (batch, n + 1, n_gen), pu.
        demand: -L, (batch, n + 1), pu.
        cost: of slack and generators, (batch, 1 + n_gen), 1/pu.
        order: generators from the cheapest to the dearest, (batch, n_gen).
        scale: smallest mean cost that others are relative to, (batch,); receives the merit order's if larger.

    Returns:
        (batch, n + 1, n_gen), rad; the first are 0.
    """
    x, powers = np.zeros(base.shape), np.empty_like(base[0])
    for b in range(len(x)):
        scale[b] = max(scale[b], _merit_order(grid, demand[b], cost[b], base[b, 0], order[b], powers))
        angles = np.dot(powers - base[b], grid.compliance)
        for j in range(1, len(powers)):
            copy_row(angles[j], x[b, j])
        if grid.is_tight:
            _cheapen(grid, base[b], demand[b], cost[b] / scale[b], x[b])
        for j in range(1, len(powers)):
            for g in range(powers.shape[1]):
                x[b, j, g] = min(max(x[b, j, g], x[b, j - 1, g] - grid.turn), x[b, j - 1, g] + grid.turn)
    return x


@inlined
def _merit_order(
    grid: CoarseGrid, demand: Array, cost: Array, p_initial: Array, order: Indices, powers: Array
) -> float:
    """Merit order at every coarse knot; mean cost. Where the bound is loose, it keeps ramps.

    While a cheap generator rises, a dearer one delivers the rest then.
    """
    n_knots, n_gen = powers.shape
    total, room = 0.0, np.empty(n_gen)
    for j in range(n_knots):
        left = demand[j]
        for g in range(n_gen):
            low, high = grid.low[g], grid.high[g]
            if not grid.is_tight:
                before, ramp = (powers[j - 1, g], grid.ramp[g]) if j > 0 else (p_initial[g], 0.0)
                low, high = max(low, before - ramp), min(high, before + ramp)
            powers[j, g], room[g] = low, high - low
            left -= low
        for g in order:
            raised = min(max(left, 0.0), room[g]) if cost[1 + g] < cost[0] else 0.0
            left -= raised
            powers[j, g] += raised
            total += cost[1 + g] * powers[j, g]
        total += cost[0] * abs(left)
    return float(total / n_knots)


@inlined
def _cheapen(grid: CoarseGrid, base: Array, demand: Array, cost: Array, x: Array) -> None:
    """Move angles, (n + 1, n_gen), towards the cheapest dispatch; costs are parts of an instance's."""
    n, n_gen = len(grid.waves), len(grid.stiffness)
    on_turns, on_powers, on_ramps, on_slack = grid.penalties
    pull, wanted = np.empty((n, n_gen)), np.empty((n, n_gen))
    turns, powers, ramps = np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen))
    slack = np.zeros((2, n))  # as the others: copies, then duals
    for k in range(ITERATIONS):
        new = RELAXATION if k > 0 else 1.0
        p = base + np.dot(x, grid.stiffness)
        for j in range(n):
            weight, short = (0.5 if j == n - 1 else 1.0) / n, demand[j + 1] - p[j + 1].sum()
            drawn = new * short + (1.0 - new) * slack[0, j] + slack[1, j] / on_slack
            paid = weight * cost[0] / on_slack
            slack[0, j] = max(drawn - paid, 0.0) + min(drawn + paid, 0.0)
            slack[1, j] = on_slack * (drawn - slack[0, j])
            shared = on_slack * (demand[j + 1] - base[j + 1].sum() - slack[0, j]) + slack[1, j]
            for g in range(n_gen):
                turn, change = x[j + 1, g] - x[j, g], p[j + 1, g] - p[j, g]
                pull[j, g] = _project(turns, j, g, new, turn, on_turns, -grid.turn, grid.turn)
                wanted[j, g] = shared - weight * cost[1 + g]
                power = _project(powers, j, g, new, p[j + 1, g], on_powers, grid.low[g], grid.high[g])
                wanted[j, g] += power - on_powers * base[j + 1, g]
                force = _project(ramps, j, g, new, change, on_ramps, -grid.ramp[g], grid.ramp[g])
                force -= on_ramps * (base[j + 1, g] - base[j, g])
                wanted[j, g] += force
                if j > 0:
                    wanted[j - 1, g] -= force
                    pull[j - 1, g] -= pull[j, g]
        moved = np.dot(grid.waves.T, pull + np.dot(wanted, grid.stiffness))
        pull[:] = 0.0
        for j in range(n):
            for i in range(n_gen):
                for g in range(n_gen):
                    pull[j, g] += moved[j, i] * grid.inverses[j, i, g]
        np.dot(grid.waves, pull, x[1:])


@inlined
def _project(
    kept: Array, j: int, g: int, new: float, value: float, weight: float, low: float, high: float
) -> float:
    """Copy and dual of a value between its limits, relaxed; returns where they pull it times the weight."""
    wanted = new * value + (1.0 - new) * kept[0, j, g] + kept[1, j, g] / weight
    copy = min(max(wanted, low), high)
    kept[0, j, g], kept[1, j, g] = copy, weight * (wanted - copy)
    return float(weight * copy - kept[1, j, g])
