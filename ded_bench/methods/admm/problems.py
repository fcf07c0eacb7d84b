"""Problems on the time grid: of instances, and drawn for training."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import DECAY_S, FLUCTUATION, sample_instances

#: Points of the time grid per interval between knots.
POINTS = 4
#: One of so many drawn problems is of the closed loop's kind.
OPERATING = 4


def problems_of(case: Case, instances: Sequence[Instance], points: Array) -> StackedInstances:
    """Instances whose `load` is sampled on a time grid, (batch, n_points, n_load), pu.

    Args:
        case: theirs.
        instances: to stack.
        points: the time grid, (n_points,), s.

    Raises:
        SimulationError: an instance gives angles at t = 0, but there is no equilibrium to compare with.
    """
    given = StackedInstances.of(case, instances)
    return dataclasses.replace(given, load=sampled(given.load, points))


def draw(case: Case, bound: float, points: Array, master: int, first: int, count: int) -> StackedInstances:
    """Draw problems: the benchmark's instances; every fourth becomes one of the closed loop.

    That kind has the ramps of another instance besides, a decaying fluctuation, powers nearer to the static
    dispatch, and mostly a state within the bound that is no equilibrium.

    Args:
        case: gives the ranges.
        bound: of |ω|, rad/s.
        points: the time grid, (n_points,), s.
        master: seed, see `problem.sampling`.
        first: index of the first instance.
        count: how many.
    """
    found = problems_of(case, list(sample_instances(case, master, count, first)), points)
    chosen = found[::OPERATING]
    generator, shape = np.random.default_rng([master, first, count]), chosen.omega.shape
    more = np.roll(found.load, 1, axis=0)[::OPERATING]
    noise = generator.standard_normal((shape[0], 1, len(case.loads))) * FLUCTUATION * case.load_nominal
    chosen.load[:] += more - more[:, :1] + noise * (np.exp(-points / DECAY_S) - 1.0)[None, :, None]
    dispatch = merit_order(case, chosen.cost[:, 1:], chosen.cost[:, 0], chosen.load[:, 0])
    chosen.p_initial[:] += generator.random((shape[0], 1)) * (dispatch - chosen.p_initial)
    chosen.delta[:] = np.clip(0.5 * bound * generator.standard_normal(shape), -0.02, 0.02)
    inside = np.clip(bound * generator.uniform(-1.0, 1.0, shape), -0.05, 0.05)
    chosen.omega[:] = np.where(generator.random((shape[0], 1)) < 0.7, inside, chosen.omega)
    return found


@compiled
def sampled(segments: Array, points: Array) -> Array:
    """Loads on a time grid; around a kink as means weighted by hat functions, which keep the area.

    Args:
        segments: see `load_segments`, (batch, n_load, n_segments, 3).
        points: the time grid, (n_points,), s.

    Returns:
        Shape (batch, n_points, n_load), pu.
    """
    spacing, values = points[1], np.empty((len(segments), len(points), segments.shape[1]))
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
    return values
