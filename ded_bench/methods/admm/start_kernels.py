"""Before any decision, compiled: samples of loads, ramp-limited dispatch, first schedules.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def first_schedules(
    problem: tuple[Array, Array, Array],
    taken: Array,
    grid: tuple[Array, Array],
    limits: tuple[Array, Array, Array],
    rate: float,
    mean_cost: Array,
    start: Array,
) -> None:
    """Schedules whose steady angles go to those of the ramp-limited dispatch, at a limited rate.

    That dispatch is a merit order at every knot, as in `problem.dispatch`, with powers no farther from those
    of the knot before than ramps allow: while a cheap generator rises, a dearer one delivers the rest.

    Args:
        problem: loads at the fine points (batch, n_fine, n_load), pu; costs of slack and generators
            (batch, 1 + n_gen); P_0 (batch, n_gen), pu.
        taken: T (L - L_0) at the fine points, (batch, n_fine, n_gen), pu.
        grid: inverse of the stiffness, and the stiffness, (n_gen, n_gen), rad/pu and pu/rad.
        limits: of powers, from below and above, and of their change between two knots, (n_gen,), pu.
        rate: most that an angle moves between two knots, rad.
        mean_cost: receives that of the dispatch over the knots, (batch,).
        start: receives the schedules, (batch, n_knots, n_gen), pu.
    """
    (load, cost, p_initial), (compliance, stiffness), (low, high, step) = problem, grid, limits
    batch, n, n_gen = start.shape
    fine = (load.shape[1] - 1) // (n - 1)
    least, room, dispatch = np.empty(n_gen), np.empty(n_gen), np.empty(n_gen)
    for b in range(batch):
        order, angles = np.argsort(cost[b, 1:], kind="mergesort"), np.empty((n, n_gen))
        mean_cost[b] = 0.0
        dispatch[:] = p_initial[b]
        for j in range(n):
            reach = 0.0 if j == 0 else 1.0
            demand = -load[b, j * fine].sum()
            for g in range(n_gen):
                least[g] = max(low[g], dispatch[g] - reach * step[g])
                room[g] = min(high[g], dispatch[g] + reach * step[g]) - least[g]
                demand -= least[g]
            price = 0.0
            for g in order:
                raised = min(max(demand, 0.0), room[g]) if cost[b, 1 + g] < cost[b, 0] else 0.0
                demand -= raised
                dispatch[g] = least[g] + raised
                price += cost[b, 1 + g] * dispatch[g]
                angles[j, g] = dispatch[g] - p_initial[b, g] - taken[b, j * fine, g]
            mean_cost[b] += (price + cost[b, 0] * abs(demand)) / n
        angles = np.dot(angles, compliance)
        angles[0] = 0.0
        for j in range(1, n):
            for g in range(n_gen):
                angles[j, g] = min(max(angles[j, g], angles[j - 1, g] - rate), angles[j - 1, g] + rate)
        powers = np.dot(angles, stiffness)
        start[b, 0] = p_initial[b]
        for j in range(1, n):
            for g in range(n_gen):
                wanted = powers[j, g] + p_initial[b, g] + taken[b, j * fine, g]
                inside, before = min(max(wanted, low[g]), high[g]), start[b, j - 1, g]
                start[b, j, g] = min(max(inside, before - step[g]), before + step[g])


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
