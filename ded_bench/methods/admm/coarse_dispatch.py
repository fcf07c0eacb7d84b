"""First schedules of `ded-admm`: the cheapest dispatch whose angles turn no faster than the bound on |ω|.

Without inertia, generators deliver P = P_0 + T (L - L_0) + S x at once, x being how far their angles are from
those at t = 0. With x linear between knots a few seconds apart, the dispatch is a small program

    min Σ_j w_j (c · P_j + c_s |P_s|_j)   with P_j, P_{j+1} - P_j and x_{j+1} - x_j within limits.

Iterations of the alternating direction method of multipliers (Boyd et al. 2011) solve it roughly, from the
merit order. The matrix of their quadratic program is always the same: it falls apart into one for each
eigenvector of DᵀD, where D takes differences in time, and these are inverted once for a case.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, inlined
from ded_bench.problem.quantities import Indices, largest_divisor

#: Coarse knots are at most so far apart, s, but for knots farther apart.
APART_S = 4.0
#: Part of the bound on |ω| at which angles turn: the rest is left to oscillations.
RATE = 0.9
#: Iterations; penalties of turns, powers, ramps and P_s; relaxation (see studies/admm.md).
ITERATIONS, PENALTIES, RELAXATION = 20, (5.5, 4.0, 5.0, 5.7), 1.35
#: Costs are relative to the merit order's, but an instance is not worth more than this mean cost per pair of
#: generators.
SMALLEST_COST = 0.05


class CoarseGrid(NamedTuple):
    """What the program has of a case, on n intervals between coarse knots."""

    every: int  # knots from one coarse knot to the next
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
    every = largest_divisor(len(knots) - 1, APART_S / float(knots[1]))
    n, apart_s = (len(knots) - 1) // every, every * float(knots[1])
    turn = RATE * bound * apart_s
    unit = float(np.exp(np.log(np.diag(stiffness) * turn).mean()))  # pu
    # one pu at one coarse knot, as a part of what all generators can give at all of them
    price = 1.0 / (n * np.maximum(np.abs(case.p_min), np.abs(case.p_max)).sum())
    penalties = price / unit * np.array(PENALTIES) * [(unit / turn) ** 2, 1.0, 1.0, 1.0]
    squares, waves = np.linalg.eigh(np.diag([2.0] * (n - 1) + [1.0]) - np.eye(n, k=1) - np.eye(n, k=-1))
    on_turns, on_powers, on_ramps, on_slack = penalties
    total = stiffness.sum(axis=0)
    same = on_powers * stiffness @ stiffness + on_slack * np.outer(total, total)
    differences = on_turns * np.eye(len(stiffness)) + on_ramps * stiffness @ stiffness
    return CoarseGrid(
        every=every,
        stiffness=stiffness,
        compliance=compliance,
        low=case.p_min,
        high=case.p_max,
        ramp=case.ramp * apart_s,
        turn=turn,
        penalties=penalties,
        waves=waves,
        inverses=np.linalg.inv(same + squares[:, None, None] * differences),
    )


@compiled
def dispatch_angles(
    grid: CoarseGrid, load: Array, cost: Array, p_initial: Array, taken: Array, order: Indices
) -> tuple[Array, Array]:
    """Angles of the dispatch, and what costs are relative to.

    Args:
        grid: the program.
        load: of all buses at the coarse knots, (batch, n + 1), pu.
        cost: of slack and generators, (batch, 1 + n_gen), 1/pu.
        p_initial: P_0, (batch, n_gen), pu.
        taken: T (L - L_0) at the coarse knots, (batch, n + 1, n_gen), pu.
        order: generators from the cheapest to the dearest, (batch, n_gen).

    Returns:
        Mean cost of the merit order, or the smallest cost, (batch,); x, (batch, n + 1, n_gen), rad.
    """
    batch, n_knots, n_gen = taken.shape
    scale, angles = np.empty(batch), np.zeros(taken.shape)
    for b in range(batch):
        powers = np.empty((n_knots, n_gen))
        mean = _merit_order(grid, load[b], cost[b], p_initial[b], order[b], powers)
        scale[b] = max(mean, SMALLEST_COST * max(1.0, 0.5 * n_gen))
        base = taken[b] + p_initial[b]
        x = np.dot(powers - base, grid.compliance)[1:]
        _iterate(grid, base, -load[b], cost[b] / scale[b], x)
        for j in range(n_knots - 1):
            for g in range(n_gen):
                before = angles[b, j, g]
                angles[b, j + 1, g] = min(max(x[j, g], before - grid.turn), before + grid.turn)
    return scale, angles


@inlined
def _merit_order(
    grid: CoarseGrid, load: Array, cost: Array, p_initial: Array, order: Indices, powers: Array
) -> float:
    """Dispatch of a merit order at every coarse knot, no farther from the one before than ramps allow.

    While a cheap generator rises, a dearer one delivers the rest.

    Returns:
        Its mean cost; `powers` receives it, (n + 1, n_gen), pu.
    """
    n_knots, n_gen = powers.shape
    least, room = np.empty(n_gen), np.empty(n_gen)
    total = 0.0
    for j in range(n_knots):
        reach, demand = (0.0 if j == 0 else 1.0), -load[j]
        for g in range(n_gen):
            before = p_initial[g] if j == 0 else powers[j - 1, g]
            least[g] = max(grid.low[g], before - reach * grid.ramp[g])
            room[g] = min(grid.high[g], before + reach * grid.ramp[g]) - least[g]
            demand -= least[g]
        for g in order:
            raised = min(max(demand, 0.0), room[g]) if cost[1 + g] < cost[0] else 0.0
            demand -= raised
            powers[j, g] = least[g] + raised
            total += cost[1 + g] * powers[j, g]
        total += cost[0] * abs(demand)
    return float(total / n_knots)


@inlined
def _iterate(grid: CoarseGrid, base: Array, demand: Array, cost: Array, x: Array) -> None:
    """Move angles x at the coarse knots but the first, (n, n_gen), towards the cheapest dispatch.

    Args:
        grid: the program.
        base: P_0 + T (L - L_0), (n + 1, n_gen), pu.
        demand: -L, (n + 1,), pu.
        cost: of slack and generators, parts of the dispatch's mean cost, (1 + n_gen,), 1/pu.
        x: rad.
    """
    n, n_gen = x.shape
    on_turns, on_powers, on_ramps, on_slack = grid.penalties
    p, pull, wanted = np.dot(x, grid.stiffness), np.empty((n, n_gen)), np.empty((n, n_gen))
    turns, powers, ramps = np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen)), np.zeros((2, n, n_gen))
    slack = np.zeros((2, n))  # as the others: copies, then duals
    for k in range(ITERATIONS):
        new = RELAXATION if k > 0 else 1.0
        for j in range(n):
            short = demand[j + 1]
            for g in range(n_gen):
                turn, change = x[j, g], base[j + 1, g] + p[j, g] - base[j, g]
                if j > 0:
                    turn, change = turn - x[j - 1, g], change - p[j - 1, g]
                power = base[j + 1, g] + p[j, g]
                short -= power
                _project(turns, j, g, new, turn, on_turns, -grid.turn, grid.turn)
                _project(powers, j, g, new, power, on_powers, grid.low[g], grid.high[g])
                _project(ramps, j, g, new, change, on_ramps, -grid.ramp[g], grid.ramp[g])
            weight = (0.5 if j == n - 1 else 1.0) / n
            drawn = new * short + (1.0 - new) * slack[0, j] + slack[1, j] / on_slack
            paid = weight * cost[0] / on_slack
            slack[0, j] = max(drawn - paid, 0.0) + min(drawn + paid, 0.0)
            slack[1, j] = on_slack * (drawn - slack[0, j])
        for j in range(n):
            short = demand[j + 1]
            for g in range(n_gen):
                short -= base[j + 1, g]
            shared = on_slack * (short - slack[0, j]) + slack[1, j]
            weight = (0.5 if j == n - 1 else 1.0) / n
            for g in range(n_gen):
                pull[j, g] = on_turns * turns[0, j, g] - turns[1, j, g]
                wanted[j, g] = shared - weight * cost[1 + g]
                wanted[j, g] += on_powers * (powers[0, j, g] - base[j + 1, g]) - powers[1, j, g]
                change = on_ramps * (ramps[0, j, g] - base[j + 1, g] + base[j, g]) - ramps[1, j, g]
                wanted[j, g] += change
                if j > 0:
                    wanted[j - 1, g] -= change
                    pull[j - 1, g] -= pull[j, g]
        moved = np.dot(grid.waves.T, pull + np.dot(wanted, grid.stiffness))
        for j in range(n):
            pull[j] = np.dot(moved[j], grid.inverses[j])
        x[:] = np.dot(grid.waves, pull)
        p = np.dot(x, grid.stiffness)


@inlined
def _project(
    kept: Array, j: int, g: int, new: float, value: float, weight: float, low: float, high: float
) -> None:
    """Copy and dual of one value between its limits, relaxed."""
    wanted = new * value + (1.0 - new) * kept[0, j, g] + kept[1, j, g] / weight
    copy = min(max(wanted, low), high)
    kept[0, j, g], kept[1, j, g] = copy, weight * (wanted - copy)
