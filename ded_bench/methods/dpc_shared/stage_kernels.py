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

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick.

    Args:
        modes: the grid.
        change: C at the instants, linear between, (batch, n_instants, n_modes, n_modes), 1/s².
        v: inputs, (batch, n_fine, n_modes).
        q: coordinates, (batch, n_fine, n_modes); the first row is given.
        speed: their derivatives, likewise.
    """
    n = v.shape[2]
    kicked, kick = np.empty(n), np.empty(n)
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
            for i in range(n):
                left, right, loss = 0.0, 0.0, 0.0
                for j in range(n):
                    left += change[b, part, i, j] * q[b, k, j]
                    right += change[b, part + 1, i, j] * q[b, k, j]
                    loss += modes.damping[i, j] * speed[b, k, j]
                kick[i] = modes.half * (left + share * (right - left) + loss)
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
    n_fine, n_out = given.offset.shape[1], weights.last.shape[1]
    n_in, columns = weights.first.shape[2], n_gen * n
    omega, p_slack, update = np.empty((n_fine, n_gen)), np.empty(n_fine), np.empty((n, n_gen))
    seen, out = np.empty((n_in, columns), np.float32), np.empty((n_out, columns), np.float32)
    p, n_stages = np.empty((n, n_gen)), len(weights.first)
    for b in range(batch):
        update[:] = 0.0
        seen[n_in - (n_out - CORRECTIONS) :] = 0.0
        p[:] = powers[b]
        least = np.inf
        for s in range(n_stages + 1):
            _respond(p, given, b, units, modes, omega, p_slack)
            loss = _loss(p, omega, p_slack, given, b, units, modes)
            if loss < least:
                least, powers[b] = loss, p
            if s < n_stages:
                _see(p, update, omega, p_slack, given, b, units, seen)
                _stage(seen, given.constant[b], s, units, dilations, weights, out)
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
    out: Array32,
) -> None:
    """The network of stage s, from what it sees to its outputs; its memory is seen by the next one."""
    n_gen, n, width = constant.shape[1], weights.times.shape[2], weights.times.shape[1]
    n_memory, columns = len(out) - CORRECTIONS, n_gen * n
    hidden, change = np.empty((width, columns), np.float32), np.empty((width, columns), np.float32)
    taps = np.empty((3 * width, columns), np.float32)
    inner, own = np.empty((width + 3 * MIXED, columns), np.float32), np.empty((width, n_gen), np.float32)
    np.dot(weights.first[s], seen, taps)
    _gather(taps, n_gen, 1, hidden)
    np.dot(weights.constant[s], constant, own)
    for o in range(width):
        for g in range(n_gen):
            row, times = hidden[o, g * n : (g + 1) * n], weights.times[s, o]
            for j in range(n):
                row[j] += own[o, g] + times[j]
    for i in range(len(dilations)):
        z = inner[:width]
        np.dot(weights.spread[s, i], hidden, taps)
        _gather(taps, n_gen, dilations[i], z)
        for o in range(width):
            row, bias = z[o], weights.spread_bias[s, i, o]
            for j in range(columns):
                row[j] = max(row[j] + bias, np.float32(0.0))
        _mix(inner, width, n_gen, units)
        np.dot(weights.mix[s, i], inner, change)
        for o in range(width):
            row, more, bias = hidden[o], change[o], weights.mix_bias[s, i, o]
            for j in range(columns):
                row[j] += more[j] + bias
    for o in range(width):
        row = hidden[o]
        for j in range(columns):
            row[j] = max(row[j], np.float32(0.0))
    np.dot(weights.last[s], hidden, out)
    for o in range(len(out)):
        row, bias = out[o], weights.last_bias[s, o]
        for j in range(columns):
            row[j] += bias
    seen[len(seen) - n_memory :] = out[CORRECTIONS:]


@compiled
def _correct(powers: Array, out: Array32, p_slack: Array, static: Array, units: Units, update: Array) -> None:
    """Correct a schedule as a stage says, and follow it within its limits; `update` receives the change."""
    n, n_gen = powers.shape
    fine, turned = (len(p_slack) - 1) // (n - 1), np.empty((n, n_gen))
    for j in range(n):
        for g in range(n_gen):
            turned[j, g] = units.turn * out[1, g * n + j]
    by_angle = np.dot(turned, units.stiffness)
    for j in range(n):
        slack = 0.0
        for start in (max(j - 1, 0), min(j, n - 2)):
            for k in range(start * fine + 1, (start + 1) * fine + 1):
                slack += 0.5 * p_slack[k] / fine
        for g in range(n_gen):
            column = g * n + j
            change = 2.0 * units.unit[g] * out[0, column] + by_angle[j, g]
            change += out[2, column] * slack + out[3, column] * (static[j, g] - powers[j, g])
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
    for j in range(n):
        for g in range(n_gen):
            unit, column = units.unit[g], g * n + j
            before = max(j - 1, 0)
            moved = p[j, g] - p[before, g]
            away = static[j, g] - p[j, g]
            seen[0, column] = (2.0 * p[j, g] - units.low[g] - units.high[g]) / (units.high[g] - units.low[g])
            seen[1, column] = _squash(0.5 * (p[j, g] - units.low[g]) / unit)
            seen[2, column] = _squash(0.5 * (units.high[g] - p[j, g]) / unit)
            seen[3, column] = _squash(away / (2.0 * unit))
            seen[4, column] = _squash(away / (20.0 * unit))
            seen[5, column] = moved / units.step[g]
            seen[6, column] = _squash(moved / unit)
            seen[7, column] = _squash((static[j, g] - static[before, g]) / unit)
            seen[8, column] = _squash(missing[j, g] / units.turn / 2.0)
            seen[9, column] = _squash(missing[j, g] / units.turn / 20.0)
            first = j * fine if j == 0 else (j - 1) * fine + 1
            most, least, slack = -MOST, MOST, 0.0
            for k in range(first, j * fine + 1):
                ratio = min(max(omega[k, g] / units.bound, -MOST), MOST)
                most, least = max(most, ratio), min(least, ratio)
                slack += p_slack[k]
            slack /= j * fine + 1 - first
            seen[10, column], seen[11, column] = most, least
            seen[12, column] = _squash(slack / unit)
            seen[13, column] = _squash(slack / (10.0 * unit))
            seen[14, column] = _squash(p_slack[j * fine] / unit)
            price[j, g] = cost[1 + g] - cost[0] * _squash(4.0 * slack / unit)
            seen[15, column] = price[j, g]
            seen[17, column] = _squash(2.0 * update[j, g] / unit)
            seen[18, column] = _squash(4.0 * (fixed[j, g] - fixed[before, g]) / unit)
    by_angle = np.dot(price, units.stiffness)
    for g in range(n_gen):
        for j in range(n):
            seen[16, g * n + j] = by_angle[j, g] / units.stiffness[g, g]
            others, before = 0.0, max(j - 1, 0)
            for i in range(n_gen):
                others += units.by_stiffness[g, i] * (p[j, i] - p[before, i]) / units.unit[i]
            seen[19, g * n + j] = _squash(2.0 * others)


@compiled
def _squash(value: float) -> float:
    """To (-1, 1)."""
    return value / (1.0 + abs(value))


@compiled
def _gather(taps: Array32, n_gen: int, dilation: int, values: Array32) -> None:
    """Add what each knot's neighbours at a distance give it, and itself; beyond both ends as at the ends."""
    n_channels, n = len(values), values.shape[1] // n_gen
    d = min(dilation, n - 1)
    for i in range(n_channels):
        for g in range(n_gen):
            first, last = g * n, (g + 1) * n
            before, after = taps[i, first:last], taps[2 * n_channels + i, first:last]
            here, row = taps[n_channels + i, first:last], values[i, first:last]
            for j in range(d):
                row[j] = here[j] + before[0]
            for j in range(d, n):
                row[j] = here[j] + before[j - d]
            for j in range(n - d):
                row[j] += after[j + d]
            for j in range(n - d, n):
                row[j] += after[n - 1]


@compiled
def _mix(inner: Array32, width: int, n_gen: int, units: Units) -> None:
    """Weighted means of hidden channels over the other generators, after the channels themselves."""
    n = inner.shape[1] // n_gen
    for i in range(MIXED):
        for kind in range(3):
            target = inner[width + kind * MIXED + i]
            target[:] = 0.0
            for g in range(n_gen):
                mixed = target[g * n : (g + 1) * n]
                for other in range(n_gen):
                    weight = np.float32(1.0 / n_gen)
                    if kind == 0:
                        weight = units.by_stiffness[g, other]
                    elif kind == 1:
                        weight = units.by_compliance[g, other]
                    if kind == 2 and g > 0:
                        break
                    source = inner[kind * MIXED + i, other * n : (other + 1) * n]
                    if weight != 0.0:
                        for j in range(n):
                            mixed[j] += weight * source[j]
                if kind == 2 and g > 0:
                    mixed[:] = target[:n]
