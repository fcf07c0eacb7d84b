"""Before any decision, compiled: the ramp-limited dispatch, and a first schedule that follows it."""

from __future__ import annotations

import numpy as np

from ded_bench.methods.ramp_follower import track
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled


@compiled
def ramp_limited_schedules(
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
        problem: loads at the grid points (batch, n_points, n_load), pu; costs of slack and generators
            (batch, 1 + n_gen); P_0 (batch, n_gen), pu.
        taken: T (L - L_0) at the grid points, (batch, n_points, n_gen), pu.
        grid: inverse of the stiffness, and the stiffness, (n_gen, n_gen), rad/pu and pu/rad.
        limits: of powers, from below and above, and of their change between two knots, (n_gen,), pu.
        rate: most that an angle moves between two knots, rad.
        mean_cost: receives that of the dispatch over the knots, (batch,).
        start: receives the schedules, (batch, n_knots, n_gen), pu.
    """
    (load, cost, p_initial), (compliance, stiffness), (low, high, step) = problem, grid, limits
    batch, n, n_gen = start.shape
    points = (load.shape[1] - 1) // (n - 1)  # of the time grid, from one knot to the next
    least, room, dispatch = np.empty(n_gen), np.empty(n_gen), np.empty(n_gen)
    for b in range(batch):
        order, angles = np.argsort(cost[b, 1:], kind="mergesort"), np.empty((n, n_gen))
        mean_cost[b] = 0.0
        dispatch[:] = p_initial[b]
        for j in range(n):
            reach = 0.0 if j == 0 else 1.0
            demand = -load[b, j * points].sum()
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
                angles[j, g] = dispatch[g] - p_initial[b, g] - taken[b, j * points, g]
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
                start[b, j, g] = powers[j, g] + p_initial[b, g] + taken[b, j * points, g]
    track(start, low, high, step)
