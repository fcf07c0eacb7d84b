"""Knots on the grid of time: where they lie, what they weigh, what limits powers, and how those follow."""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.compiled import compiled
from ded_bench.problem.instance import Instance

#: In operation under secondary control, knots are as close as the case's so far ahead, s: on three drawn
#: scenarios of two-area-agc and 39bus-agc 3 s let one peak pass the bound by 0.3 mHz, and from 6 to 10 s
#: neither peaks nor costs changed by more than 0.06 %.
NEAR_S = 8.0


def is_reachable(case: Case, instance: Instance, points: Indices) -> bool:
    """Whether ramps reach the generator bounds in time: these are constant, so t_1 decides.

    Args:
        points: grid points of the knots.
    """
    p_min, p_max = power_limits(case, instance, np.diff(points))
    reach, p_initial = case.ramp * instance.grid[points[1]], instance.p_initial(case)
    return bool(((p_min[0] <= p_initial + reach) & (p_max[0] >= p_initial - reach)).all())


def control_times(case: Case, instance: Instance) -> Array:
    """When secondary control acts before the horizon, s: there every program has knots."""
    if case.agc is None:
        return np.empty(0)
    given = instance.initial.agc
    first = given.next_s if given is not None and given.next_s is not None else case.agc.period_s
    return np.arange(first, instance.horizon_s - instance.dt_s / 2, case.agc.period_s)


def knot_points(times: Array, dt_s: float) -> Indices:
    """Grid points of knots at `times` (s): inputs are linear between grid points, so knots lie on them."""
    return np.unique(np.rint(times / dt_s).astype(int))


def case_knots(case: Case, instance: Instance, distance_s: float | None = None) -> Indices:
    """Grid points of the case's knots, or of those at a distance, and of times of secondary control."""
    horizon_s, times = instance.horizon_s, case.knot_times(instance.horizon_s)
    if distance_s is not None:
        times = np.linspace(0.0, horizon_s, max(round(horizon_s / distance_s), 1) + 1)
    return knot_points(np.concatenate([times, control_times(case, instance)]), instance.dt_s)


def knots_in_operation(case: Case, instance: Instance) -> Indices:
    """Grid points of knots of a plan that will be made anew: the case's.

    Under secondary control its times are knots, wherever plans start. Beyond NEAR_S they are the only ones.
    """
    if case.agc is None:
        return case_knots(case, instance)
    times = case.knot_times(instance.horizon_s)
    near = times[times < NEAR_S], times[-1:]
    return knot_points(np.concatenate([*near, control_times(case, instance)]), instance.dt_s)


def knots_on_clock(case: Case, instance: Instance, now_s: float) -> Indices:
    """Grid points of knots at multiples of the case's distance on a clock: they keep their places.

    Args:
        case: gives the distance.
        instance: gives the grid.
        now_s: what the clock says at its t = 0, s.
    """
    distance = case.sampling.horizon_s / (case.n_knots - 1)
    last = instance.horizon_s - distance / 2
    inside = np.arange(np.floor(now_s / distance + 1e-6) + 1, (now_s + last) / distance) * distance - now_s
    return knot_points(np.concatenate([[0.0], inside, [instance.horizon_s]]), instance.dt_s)


def knot_weights(lengths: Indices) -> Array:
    """How much power at a knot counts in the sum over all grid points, shape (n_knots,)."""
    half = (lengths - 1) / 2
    weight = np.ones(len(lengths) + 1)
    weight[:-1] += half
    weight[1:] += half
    return weight


def divided(points: Indices, parts: Indices) -> Indices:
    """First grid points of so many nearly equal parts of every interval between knots."""
    start, length, count = (np.repeat(values, parts) for values in (points[:-1], np.diff(points), parts))
    number = np.arange(len(count)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.asarray(start + length * number // count)


def power_limits(case: Case, instance: Instance, lengths: Indices) -> tuple[Array, Array]:
    """Lowest and highest power at all knots but the first, shape (n_intervals, n_gen), pu.

    P_0 is given, wherever it lies, but the limits hold from t_1 on, before the next knot.
    """
    p_initial = instance.p_initial(case)
    p_min, p_max = np.tile(case.p_min, (len(lengths), 1)), np.tile(case.p_max, (len(lengths), 1))
    part = 1.0 / lengths[0]
    p_min[0] = np.maximum(case.p_min, (case.p_min - (1 - part) * p_initial) / part)
    p_max[0] = np.minimum(case.p_max, (case.p_max - (1 - part) * p_initial) / part)
    return p_min, p_max


def transfer_room(case: Case, instance: Instance, points: Indices) -> Array:
    """What machines of a transfer may deliver at all knots but the first, (n_intervals, n_transfers), pu.

    Set-points are linear between knots and loads need not be: what a load lies above its chord, in either
    interval beside a knot, is taken off.
    """
    p_load, grid = instance.p_load(case), np.arange(instance.steps + 1)
    _, by_load, limit = case.transfer_rows
    most = limit - p_load @ by_load.T
    room = most[points[1:]]
    for column, whole in zip(room.T, most.T, strict=True):
        short = np.maximum(np.interp(grid, points, whole[points]) - whole, 0.0)
        largest = np.maximum.reduceat(short, points[:-1])
        column -= np.maximum(largest, np.append(largest[1:], 0.0))
    return room


@compiled
def track(p_gen: Array, low: Array, high: Array, step: Array) -> None:
    """Turn the targets of a batch into powers that follow them as fast as bounds and ramps allow, in place.

        p_0 = P_0,   p_{j+1} = min(max(clip(target_{j+1}), p_j - step), p_j + step)

    By induction p stays within the generator bounds if P_0 is. Between knots a schedule is linear, so no two
    neighbouring grid points differ by more than the ramp limit.

    Args:
        p_gen: P_0, then the targets, shape (batch, n_knots, n_gen), pu.
        low: lower bounds, (n_gen,), pu; likewise `high`.
        high: upper bounds.
        step: largest change between two knots, the ramp limit times their spacing, (n_gen,), pu.
    """
    for b in range(p_gen.shape[0]):
        for j in range(1, p_gen.shape[1]):
            for g in range(p_gen.shape[2]):
                before = p_gen[b, j - 1, g]
                target = min(max(p_gen[b, j, g], low[g]), high[g])
                p_gen[b, j, g] = min(max(target, before - step[g]), before + step[g])
