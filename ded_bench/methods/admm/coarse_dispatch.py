"""First schedules of `ded-admm`: the cheapest dispatch whose angles turn no faster than the bound on |ω|.

Without inertia, generators deliver P = P_0 + T (L - L_0) + S x at once, x being how far their angles are from
those at t = 0. With x linear between knots a few seconds apart, the dispatch is a small program

    min Σ_j w_j (c · P_j + c_s |P_s|_j)   with P_j, P_{j+1} - P_j and x_{j+1} - x_j within limits.

Iterations of the alternating direction method of multipliers (Boyd et al. 2011) solve it roughly. The matrix
of their quadratic program is always the same: it falls apart into one for each eigenvector of DᵀD, where D
takes differences in time, and these are inverted once for a case.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, inlined
from ded_bench.problem.quantities import largest_divisor

#: Coarse knots are at most so far apart, s, but for knots farther apart.
APART_S = 4.0
#: Part of the bound on |ω| at which angles turn: the rest is left to oscillations.
RATE = 0.9
#: Iterations; penalties of turns, powers, ramps and P_s; relaxation (see studies/admm.md).
ITERATIONS, PENALTIES, RELAXATION = 40, (5.5, 4.0, 5.0, 5.7), 1.35


class CoarseGrid(NamedTuple):
    """What the program has of a case, on n intervals between coarse knots."""

    every: int  # knots from one coarse knot to the next
    stiffness: Array  # S, (n_gen, n_gen), pu/rad
    low: Array  # of powers, (n_gen,), pu
    high: Array
    ramp: Array  # largest change of powers over an interval, (n_gen,), pu
    turn: float  # largest change of angles, rad
    penalties: Array  # of turns (1/rad²), powers, ramps and P_s (1/pu²), (4,)
    waves: Array  # eigenvectors of DᵀD by column, (n, n)
    inverses: Array  # of the quadratic program, for each of them, (n, n_gen, n_gen)


def coarse_grid(case: Case, knots: Array, bound: float, stiffness: Array) -> CoarseGrid:
    """The program of a case.

    Args:
        case: gives limits of powers.
        knots: of schedules, (n_knots,), s.
        bound: of |ω|, rad/s.
        stiffness: S, (n_gen, n_gen), pu/rad.
    """
    every = largest_divisor(len(knots) - 1, APART_S / float(knots[1]))
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
    ramp = case.ramp * apart_s
    return CoarseGrid(every, stiffness, case.p_min, case.p_max, ramp, turn, penalties, waves, inverses)


@compiled
def cheapen(grid: CoarseGrid, base: Array, demand: Array, cost: Array, x: Array) -> None:
    """Move angles towards the cheapest dispatch, then within their limits.

    Args:
        grid: the program.
        base: P_0 + T (L - L_0) at the coarse knots, (batch, n + 1, n_gen), pu.
        demand: -L, (batch, n + 1), pu.
        cost: of slack and generators, parts of an instance's cost, (batch, 1 + n_gen), 1/pu.
        x: angles, which change, (batch, n + 1, n_gen), rad; the first are 0.
    """
    n, n_gen = len(grid.waves), len(grid.stiffness)
    on_turns, on_powers, on_ramps, on_slack = grid.penalties
    pull, wanted = np.empty((n, n_gen)), np.empty((n, n_gen))
    for b in range(len(x)):
        turns, powers, ramps = np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen))
        slack = np.zeros((2, n))  # as the others: copies, then duals
        for k in range(ITERATIONS):
            new = RELAXATION if k > 0 else 1.0
            p = base[b] + np.dot(x[b], grid.stiffness)
            for j in range(n):
                weight, short = (0.5 if j == n - 1 else 1.0) / n, demand[b, j + 1] - p[j + 1].sum()
                drawn = new * short + (1.0 - new) * slack[0, j] + slack[1, j] / on_slack
                paid = weight * cost[b, 0] / on_slack
                slack[0, j] = max(drawn - paid, 0.0) + min(drawn + paid, 0.0)
                slack[1, j] = on_slack * (drawn - slack[0, j])
                shared = on_slack * (demand[b, j + 1] - base[b, j + 1].sum() - slack[0, j]) + slack[1, j]
                for g in range(n_gen):
                    turn, change = x[b, j + 1, g] - x[b, j, g], p[j + 1, g] - p[j, g]
                    pull[j, g] = _project(turns, j, g, new, turn, on_turns, -grid.turn, grid.turn)
                    wanted[j, g] = shared - weight * cost[b, 1 + g]
                    power = _project(powers, j, g, new, p[j + 1, g], on_powers, grid.low[g], grid.high[g])
                    wanted[j, g] += power - on_powers * base[b, j + 1, g]
                    force = _project(ramps, j, g, new, change, on_ramps, -grid.ramp[g], grid.ramp[g])
                    force -= on_ramps * (base[b, j + 1, g] - base[b, j, g])
                    wanted[j, g] += force
                    if j > 0:
                        wanted[j - 1, g] -= force
                        pull[j - 1, g] -= pull[j, g]
            moved = np.dot(grid.waves.T, pull + np.dot(wanted, grid.stiffness))
            for j in range(n):
                pull[j] = 0.0
                for i in range(n_gen):
                    for g in range(n_gen):
                        pull[j, g] += moved[j, i] * grid.inverses[j, i, g]
            x[b, 1:] = np.dot(grid.waves, pull)
        for j in range(n):
            for g in range(n_gen):
                x[b, j + 1, g] = min(max(x[b, j + 1, g], x[b, j, g] - grid.turn), x[b, j, g] + grid.turn)


@inlined
def _project(
    kept: Array, j: int, g: int, new: float, value: float, weight: float, low: float, high: float
) -> float:
    """Copy and dual of a value between its limits, relaxed; returns where they pull it times the weight."""
    wanted = new * value + (1.0 - new) * kept[0, j, g] + kept[1, j, g] / weight
    copy = min(max(wanted, low), high)
    kept[0, j, g], kept[1, j, g] = copy, weight * (wanted - copy)
    return float(weight * copy - kept[1, j, g])
