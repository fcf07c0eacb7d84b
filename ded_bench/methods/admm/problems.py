"""Problems on the time grid: of instances, and drawn for training; their first schedules."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ded_bench.methods.knots import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Array, Case, Indices
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


@compiled
def ramp_limited_schedules(
    problem: tuple[Array, Array, Array],
    order: Indices,
    taken: Array,
    grid: tuple[Array, Array],
    limits: tuple[Array, Array, Array],
    rate: float,
    n: int,
) -> tuple[Array, Array]:
    """Schedules whose steady angles go to those of the ramp-limited dispatch, at a limited rate.

    That dispatch is a merit order at every knot, as in `problem.dispatch`, with powers no farther from those
    of the knot before than ramps allow: while a cheap generator rises, a dearer one delivers the rest.

    Args:
        problem: loads at the grid points (batch, n_points, n_load), pu; costs of slack and generators
            (batch, 1 + n_gen); P_0 (batch, n_gen), pu.
        order: generators from the cheapest to the dearest, (batch, n_gen).
        taken: T (L - L_0) at the grid points, (batch, n_points, n_gen), pu.
        grid: inverse of the stiffness, and the stiffness, (n_gen, n_gen), rad/pu and pu/rad.
        limits: of powers, from below and above, and of their change between two knots, (n_gen,), pu.
        rate: most that an angle moves between two knots, rad.
        n: how many knots there are.

    Returns:
        Mean cost of the dispatch over the knots, (batch,), and the schedules, (batch, n, n_gen), pu.
    """
    (load, cost, p_initial), (compliance, stiffness), (low, high, step) = problem, grid, limits
    batch, n_gen = p_initial.shape
    mean_cost, start = np.empty(batch), np.empty((batch, n, n_gen))
    points = (load.shape[1] - 1) // (n - 1)  # of the time grid, from one knot to the next
    least, room, dispatch = np.empty(n_gen), np.empty(n_gen), np.empty(n_gen)
    for b in range(batch):
        angles = np.empty((n, n_gen))
        mean_cost[b] = 0.0
        for g in range(n_gen):
            dispatch[g] = start[b, 0, g] = p_initial[b, g]
        for j in range(n):
            reach = 0.0 if j == 0 else 1.0
            demand = -load[b, j * points].sum()
            for g in range(n_gen):
                least[g] = max(low[g], dispatch[g] - reach * step[g])
                room[g] = min(high[g], dispatch[g] + reach * step[g]) - least[g]
                demand -= least[g]
            price = 0.0
            for g in order[b]:
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
        for j in range(1, n):
            for g in range(n_gen):
                start[b, j, g] = powers[j, g] + p_initial[b, g] + taken[b, j * points, g]
    track(start, low, high, step)
    return mean_cost, start
