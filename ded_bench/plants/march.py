"""The march of a linear time-varying model through its intervals, compiled: most of a prediction."""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array, Indices
from ded_bench.problem.compiled import compiled


@compiled
def march(
    f: Array, which: Indices, state: Array, force: Array, growth: Array, points: Indices, found: Array
) -> None:
    """Fill in the points between knots, interval by interval, so that a map stays in the cache.

    Args:
        f: maps of states from grid point to grid point, (n_maps, n_state, n_state), contiguous.
        which: the map of each interval, (n_intervals,).
        state: at its start, (n_intervals, n_state).
        force: what inputs add over its first step, (n_intervals, n_state).
        growth: by how much that grows from step to step, (n_intervals, n_state).
        points: grid points of the knots, (n_intervals + 1,).
        found: receives the states between knots, (n_points, n_state).
    """
    for j in range(len(which)):
        now, push = state[j], force[j].copy()
        for k in range(points[j] + 1, points[j + 1]):
            np.dot(f[which[j]], now, found[k])
            for i in range(len(push)):
                found[k, i] += push[i]
                push[i] += growth[j, i]
            now = found[k]
