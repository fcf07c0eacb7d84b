"""All that Numba compiles of the policy itself: the swing of the modes, the follower, inputs and network.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

import numpy as np

from ded_bench.methods.dpc_shared.stage_records import (
    CORRECTIONS,
    DOUBLING,
    MIXED,
    PRICE,
    STRAIGHT,
    Array32,
    Given,
    Indices,
    Modes,
    Units,
    Weights,
)
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

#: Largest ratio of |ω| to its bound that the network sees.
MOST = np.float64(3.0)


@compiled
def swing(modes: Modes, change: Array, v: Array, q: Array, speed: Array) -> None:
    """Advance problems from one fine point to the next: q̈ + γ q̇ + λ q + δD q̇ + C(t) q = v.

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick. Both are symmetric,
    so that products add up rows.

    Args:
        modes: the grid.
        change: C at the instants, linear between, (batch, n_instants, n_modes, n_modes), 1/s².
        v: inputs, (batch, n_fine, n_modes).
        q: coordinates, (batch, n_fine, n_modes); the first row is given.
        speed: their derivatives, likewise.
    """
    n = v.shape[2]
    kicked, kick, damped = np.empty(n), np.empty(n), np.any(modes.damping != 0.0)
    for b in range(len(v)):
        part = 0
        for k in range(v.shape[1]):
            if k > modes.instants[part + 1] and part + 2 < len(modes.instants):
                part += 1
            share = (k - modes.instants[part]) / (modes.instants[part + 1] - modes.instants[part])
            if k > 0:
                for i in range(n):
                    a, before = modes.step[i], v[b, k - 1, i]
                    q[b, k, i] = (
                        a[0, 0] * q[b, k - 1, i]
                        + a[0, 1] * kicked[i]
                        + a[0, 2] * before
                        + a[0, 3] * v[b, k, i]
                    )
                    speed[b, k, i] = (
                        a[1, 0] * q[b, k - 1, i]
                        + a[1, 1] * kicked[i]
                        + a[1, 2] * before
                        + a[1, 3] * v[b, k, i]
                    )
            kick[:] = 0.0
            for j in range(n):
                later = modes.half * share * q[b, k, j]
                now = modes.half * q[b, k, j] - later
                left, right = change[b, part, j], change[b, part + 1, j]
                for i in range(n):
                    kick[i] += now * left[i] + later * right[i]
            if damped:
                for j in range(n):
                    loss, row = modes.half * speed[b, k, j], modes.damping[j]
                    for i in range(n):
                        kick[i] += loss * row[i]
            for i in range(n):
                if k > 0:
                    speed[b, k, i] -= kick[i]
                kicked[i] = speed[b, k, i] - kick[i]


@compiled
def track_rows(targets: Array, low: Array, high: Array, step: Array) -> None:
    """Follow targets within bounds and ramps, in place.

    Args:
        targets: of several schedules, (batch, n_knots, n_gen), pu; the first knot's are P_0.
        low: (n_gen,), pu; likewise `high`.
        step: largest change between two knots, (n_gen,), pu.
    """
    for b in range(len(targets)):
        for j in range(1, targets.shape[1]):
            for g in range(targets.shape[2]):
                before = targets[b, j - 1, g]
                target = min(max(targets[b, j, g], low[g]), high[g])
                targets[b, j, g] = min(max(target, before - step[g]), before + step[g])


@compiled
def answer(
    powers: Array, given: Given, units: Units, modes: Modes, dilations: Indices, weights: Weights
) -> None:
    """Turn first schedules into answers: what is best of them and of what each stage makes of them.

    Args:
        powers: (batch, n_knots, n_gen), pu; receives the answers.
        given: the problems.
        units: of the case.
        modes: of the case.
        dilations: of each stage's blocks, in knots.
        weights: of the network.
    """
    batch, n, n_gen = powers.shape
    n_fine, n_out = given.offset.shape[1], weights.last.shape[2]
    n_in, width = weights.first.shape[1] // 3, weights.times.shape[2]
    omega, p_slack, update = np.empty((n_fine, n_gen)), np.empty(n_fine), np.empty((n, n_gen))
    seen, out = np.empty((n_gen, n, n_in), np.float32), np.empty((n_gen, n, n_out), np.float32)
    hidden = np.empty((n_gen, n, width), np.float32)
    inner = np.empty((n_gen, n, width + 3 * MIXED), np.float32)
    p, n_stages = np.empty((n, n_gen)), len(weights.first)
    for b in range(batch):
        update[:] = 0.0
        seen[:, :, n_in - (n_out - CORRECTIONS) :] = 0.0
        p[:] = powers[b]
        least = np.inf
        for s in range(n_stages + 1):
            _respond(p, given, b, units, modes, omega, p_slack)
            loss = _loss(p, omega, p_slack, given, b, units, modes)
            if loss < least:
                least, powers[b] = loss, p
            if s < n_stages:
                _see(p, update, omega, p_slack, given, b, units, seen)
                _stage(seen, given.constant[b], s, units, dilations, weights, hidden, inner, out)
                _correct(p, out, p_slack, given.static[b], units, update)


@compiled
def _loss(p: Array, omega: Array, p_slack: Array, given: Given, b: int, units: Units, modes: Modes) -> float:
    """Cost as a part of the static dispatch's, and the penalty; see `ScheduleLoss`."""
    cost, penalty, (n, n_gen), n_fine = 0.0, 0.0, p.shape, len(p_slack)
    for j in range(n):
        for g in range(n_gen):
            share = 0.5 if j == 0 or j == n - 1 else 1.0
            cost += share * given.cost[b, 1 + g] * p[j, g] / (n - 1)
    for k in range(n_fine):
        share = 0.5 if k == 0 or k == n_fine - 1 else 1.0
        cost += share * given.cost[b, 0] * abs(p_slack[k]) / (n_fine - 1)
        for g in range(n_gen):
            excess = abs(omega[k, g]) / units.bound - 1.0
            if excess > 0.0:
                bent = min(excess, STRAIGHT)
                penalty += excess + (excess - 0.5 * bent) * bent / DOUBLING
    return float(cost / given.scale[b] + PRICE * penalty * 2.0 * modes.half)


@compiled
def _respond(
    powers: Array, given: Given, b: int, units: Units, modes: Modes, omega: Array, p_slack: Array
) -> None:
    """What a schedule does: ω (n_fine, n_gen) and P_s (n_fine,); see `PathModel.respond`."""
    (n, n_gen), n_fine = powers.shape, len(p_slack)
    fine, force = (n_fine - 1) // (n - 1), np.empty((1, n_fine, n_gen))
    q, speed, p_fine = np.empty(force.shape), np.empty(force.shape), np.empty(omega.shape)
    for j in range(n - 1):
        for i in range(fine):
            share = i / fine
            for g in range(n_gen):
                here = powers[j, g] + share * (powers[j + 1, g] - powers[j, g])
                p_fine[j * fine + i, g] = here + given.offset[b, j * fine + i, g]
    for g in range(n_gen):
        p_fine[n_fine - 1, g] = powers[n - 1, g] + given.offset[b, n_fine - 1, g]
    np.dot(p_fine, units.gain, force[0])
    q[0, 0], speed[0, 0] = given.state[b, 0], given.state[b, 1]
    swing(modes, given.change[b : b + 1], force, q, speed)
    np.dot(q[0], units.shape, p_fine)
    np.dot(speed[0], units.shape, omega)
    for k in range(n_fine):
        p_slack[k] = given.slack[b, k]
        for g in range(n_gen):
            p_slack[k] -= given.leverage[b, k, g] * p_fine[k, g]


@compiled
def _stage(
    seen: Array32,
    constant: Array32,
    s: int,
    units: Units,
    dilations: Indices,
    weights: Weights,
    hidden: Array32,
    inner: Array32,
    out: Array32,
) -> None:
    """The network of stage s, from what it sees to its outputs; its memory is seen by the next one.

    All arrays are (n_gen, n_knots, n_channels): those of one generator stay in the cache.
    """
    n_gen, n, n_in = seen.shape
    width, n_memory, zero = hidden.shape[2], out.shape[2] - CORRECTIONS, np.float32(0.0)
    near_seen, near = np.empty((n, 3 * n_in), np.float32), np.empty((n, 3 * width), np.float32)
    own, change = np.dot(constant, weights.constant[s]), np.empty((n, width), np.float32)
    for g in range(n_gen):
        _gather(seen[g], 1, near_seen)
        np.dot(near_seen, weights.first[s], hidden[g])
        for j in range(n):
            for o in range(width):
                hidden[g, j, o] += own[g, o] + weights.times[s, j, o]
    for i in range(len(dilations)):
        for g in range(n_gen):
            _gather(hidden[g], dilations[i], near)
            np.dot(near, weights.spread[s, i], change)
            for j in range(n):
                for o in range(width):
                    inner[g, j, o] = max(change[j, o] + weights.spread_bias[s, i, o], zero)
        _mix(inner, width, units)
        for g in range(n_gen):
            np.dot(inner[g], weights.mix[s, i], change)
            for j in range(n):
                for o in range(width):
                    hidden[g, j, o] += change[j, o] + weights.mix_bias[s, i, o]
    for g in range(n_gen):
        for j in range(n):
            for o in range(width):
                hidden[g, j, o] = max(hidden[g, j, o], zero)
        np.dot(hidden[g], weights.last[s], out[g])
        for j in range(n):
            for o in range(out.shape[2]):
                out[g, j, o] += weights.last_bias[s, o]
        seen[g, :, n_in - n_memory :] = out[g, :, CORRECTIONS:]


@compiled
def _correct(powers: Array, out: Array32, p_slack: Array, static: Array, units: Units, update: Array) -> None:
    """Correct a schedule as a stage says, and follow it within its limits; `update` receives the change."""
    n, n_gen = powers.shape
    fine, turned = (len(p_slack) - 1) // (n - 1), np.empty((n, n_gen))
    for j in range(n):
        for g in range(n_gen):
            turned[j, g] = units.turn * out[g, j, 1]
    by_angle = np.dot(turned, units.stiffness)
    for j in range(n):
        slack = 0.0
        for start in (max(j - 1, 0), min(j, n - 2)):
            for k in range(start * fine + 1, (start + 1) * fine + 1):
                slack += 0.5 * p_slack[k] / fine
        for g in range(n_gen):
            change = 2.0 * units.unit[g] * out[g, j, 0] + by_angle[j, g]
            change += out[g, j, 2] * slack + out[g, j, 3] * (static[j, g] - powers[j, g])
            update[j, g] = powers[j, g]
            if j > 0:
                powers[j, g] += units.pace[g] * change
    track_rows(powers.reshape(1, n, n_gen), units.low, units.high, units.step)
    for j in range(n):
        for g in range(n_gen):
            update[j, g] = powers[j, g] - update[j, g]


@compiled
def _see(
    p: Array,
    update: Array,
    omega: Array,
    p_slack: Array,
    given: Given,
    b: int,
    units: Units,
    seen: Array32,
) -> None:
    """Channels of a stage but its memory; see `UnrolledNetwork.sequence`."""
    n, n_gen = p.shape
    fine, cost, static, fixed = (len(omega) - 1) // (n - 1), given.cost[b], given.static[b], given.fixed[b]
    missing, price = np.dot(static - p, units.compliance), np.empty((n, n_gen))
    relative = np.empty((n_gen, n), np.float32)
    for g in range(n_gen):
        unit = units.unit[g]
        for j in range(n):
            before, channels = max(j - 1, 0), seen[g, j]
            moved = p[j, g] - p[before, g]
            away = static[j, g] - p[j, g]
            relative[g, j] = moved / unit
            channels[0] = (2.0 * p[j, g] - units.low[g] - units.high[g]) / (units.high[g] - units.low[g])
            channels[1] = _squash(0.5 * (p[j, g] - units.low[g]) / unit)
            channels[2] = _squash(0.5 * (units.high[g] - p[j, g]) / unit)
            channels[3] = _squash(away / (2.0 * unit))
            channels[4] = _squash(away / (20.0 * unit))
            channels[5] = moved / units.step[g]
            channels[6] = _squash(moved / unit)
            channels[7] = _squash((static[j, g] - static[before, g]) / unit)
            channels[8] = _squash(missing[j, g] / units.turn / 2.0)
            channels[9] = _squash(missing[j, g] / units.turn / 20.0)
            first = j * fine if j == 0 else (j - 1) * fine + 1
            most, least, slack = -MOST, MOST, 0.0
            for k in range(first, j * fine + 1):
                ratio = min(max(omega[k, g] / units.bound, -MOST), MOST)
                most, least = max(most, ratio), min(least, ratio)
                slack += p_slack[k]
            slack /= j * fine + 1 - first
            channels[10], channels[11] = most, least
            channels[12] = _squash(slack / unit)
            channels[13] = _squash(slack / (10.0 * unit))
            channels[14] = _squash(p_slack[j * fine] / unit)
            price[j, g] = cost[1 + g] - cost[0] * _squash(4.0 * slack / unit)
            channels[15] = price[j, g]
            channels[17] = _squash(2.0 * update[j, g] / unit)
            channels[18] = _squash(4.0 * (fixed[j, g] - fixed[before, g]) / unit)
    by_angle, others = np.dot(price, units.stiffness), np.dot(units.by_stiffness, relative)
    for g in range(n_gen):
        for j in range(n):
            seen[g, j, 16] = by_angle[j, g] / units.stiffness[g, g]
            seen[g, j, 19] = _squash(2.0 * others[g, j])


@compiled
def _squash(value: float) -> float:
    """To (-1, 1)."""
    return value / (1.0 + abs(value))


@compiled
def _gather(values: Array32, dilation: int, near: Array32) -> None:
    """Beside each other what knots before, here and after have; beyond both ends as at the ends."""
    n, width = values.shape
    for j in range(n):
        before, after = max(j - dilation, 0), min(j + dilation, n - 1)
        for o in range(width):
            near[j, o] = values[before, o]
            near[j, width + o] = values[j, o]
            near[j, 2 * width + o] = values[after, o]


@compiled
def _mix(inner: Array32, width: int, units: Units) -> None:
    """Weighted means of hidden channels over the other generators, after the channels themselves."""
    n_gen, n, _ = inner.shape
    source, mean = np.empty((n_gen, n, MIXED), np.float32), np.zeros((n, MIXED), np.float32)
    for kind in range(3):
        source[:] = inner[:, :, kind * MIXED : (kind + 1) * MIXED]
        first = width + kind * MIXED
        target, flat = inner[:, :, first : first + MIXED], source.reshape(n_gen, -1)
        if kind == 0:
            target[:] = np.dot(units.by_stiffness, flat).reshape(n_gen, n, MIXED)
        elif kind == 1:
            target[:] = np.dot(units.by_compliance, flat).reshape(n_gen, n, MIXED)
        else:
            for g in range(n_gen):
                mean += source[g] / np.float32(n_gen)
            target[:] = mean
