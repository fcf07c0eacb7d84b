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
    Floats,
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
def swing(modes: Modes, change: Floats, v: Floats, q: Floats, speed: Floats) -> None:
    """Advance problems from one fine point to the next: q̈ + γ q̇ + λ q + δD q̇ + C(t) q = v.

    Strang's splitting: half a kick by δD and C, the exact map of the rest, half a kick. Both are symmetric,
    so that products add up rows.

    Args:
        modes: the grid; its arrays and the others are all of one precision.
        change: C at the instants, linear between, (batch, n_instants, n_modes, n_modes), 1/s².
        v: inputs, (batch, n_fine, n_modes).
        q: coordinates, (batch, n_fine, n_modes); the first row is given.
        speed: their derivatives, likewise.
    """
    n = v.shape[2]
    kicked, kick, damped = np.empty(n, v.dtype), np.empty(n, v.dtype), np.any(modes.damping != 0.0)
    shares = np.empty(3, v.dtype)  # of C before and after, and of δD, times half a step
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
            shares[0], shares[1], shares[2] = modes.half * (1.0 - share), modes.half * share, modes.half
            kick[:] = 0.0
            for j in range(n):
                now, later = shares[0] * q[b, k, j], shares[1] * q[b, k, j]
                left, right = change[b, part, j], change[b, part + 1, j]
                for i in range(n):
                    kick[i] += now * left[i] + later * right[i]
            if damped:
                for j in range(n):
                    loss, row = shares[2] * speed[b, k, j], modes.damping[j]
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
    n_fine, n_out = given.offset.shape[1], weights.last.shape[1]
    n_in, width = weights.first.shape[2], weights.first.shape[1] // 3
    omega, p_slack = np.empty((n_fine, n_gen), np.float32), np.empty(n_fine, np.float32)
    update = np.empty((n, n_gen))
    seen, out = np.empty((n_gen, n_in, n), np.float32), np.empty((n_gen, n_out, n), np.float32)
    hidden = np.empty((n_gen, width, n), np.float32)
    inner = np.empty((n_gen, width + 3 * MIXED, n), np.float32)
    p, n_stages = np.empty((n, n_gen)), len(weights.first)
    for b in range(batch):
        update[:] = 0.0
        seen[:, n_in - (n_out - CORRECTIONS) :] = 0.0
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
def _loss(
    p: Array, omega: Array32, p_slack: Array32, given: Given, b: int, units: Units, modes: Modes
) -> float:
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
    powers: Array, given: Given, b: int, units: Units, modes: Modes, omega: Array32, p_slack: Array32
) -> None:
    """What a schedule does: ω (n_fine, n_gen) and P_s (n_fine,); see `PathModel.respond`."""
    (n, n_gen), n_fine = powers.shape, len(p_slack)
    fine, force = (n_fine - 1) // (n - 1), np.empty((1, n_fine, n_gen), np.float32)
    q, speed, p_fine = np.empty_like(force), np.empty_like(force), np.empty_like(omega)
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
    np.dot(speed[0], units.shape, omega)
    for k in range(n_fine):
        p_slack[k] = given.slack[b, k] - np.dot(given.leverage[b, k], q[0, k])


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

    All arrays are (n_gen, n_channels, n_knots): those of one generator stay in the cache, and loops over
    knots are the inner ones.
    """
    n_gen, n_in, n = seen.shape
    width, n_memory, zero = hidden.shape[1], out.shape[1] - CORRECTIONS, np.float32(0.0)
    own, change = np.dot(constant, weights.constant[s]), np.empty((width, n), np.float32)
    taps, pooled = np.empty((3 * width, n), np.float32), np.empty((MIXED, n), np.float32)
    source, nothing = np.empty((2, n_gen, MIXED, n), np.float32), np.zeros(width, np.float32)
    mean, flat = np.empty_like(source), (n_gen, MIXED * n)
    for g in range(n_gen):
        _convolve(weights.first[s], seen[g], 1, taps, hidden[g])
        _add(weights.times[s], own[g], hidden[g])
    for i in range(len(dilations)):
        pooled[:] = zero
        for g in range(n_gen):
            _convolve(weights.spread[s, i], hidden[g], dilations[i], taps, inner[g, :width])
            _rectify(weights.spread_bias[s, i], inner[g, :width])
            _copy(inner[g, :MIXED], source[0, g])
            _copy(inner[g, MIXED : 2 * MIXED], source[1, g])
            _add(inner[g, 2 * MIXED : 3 * MIXED], nothing, pooled)
        np.dot(units.by_stiffness, source[0].reshape(flat), mean[0].reshape(flat))
        np.dot(units.by_compliance, source[1].reshape(flat), mean[1].reshape(flat))
        pooled /= np.float32(n_gen)
        for g in range(n_gen):
            _copy(mean[0, g], inner[g, width : width + MIXED])
            _copy(mean[1, g], inner[g, width + MIXED : width + 2 * MIXED])
            _copy(pooled, inner[g, width + 2 * MIXED :])
            np.dot(weights.mix[s, i], inner[g], change)
            _add(change, weights.mix_bias[s, i], hidden[g])
    for g in range(n_gen):
        _rectify(nothing, hidden[g])
        np.dot(weights.last[s], hidden[g], out[g])
        for o in range(out.shape[1]):
            out[g, o] += weights.last_bias[s, o]
        _copy(out[g, CORRECTIONS:], seen[g, n_in - n_memory :])


@compiled
def _correct(
    powers: Array, out: Array32, p_slack: Array32, static: Array, units: Units, update: Array
) -> None:
    """Correct a schedule as a stage says, and follow it within its limits; `update` receives the change."""
    n, n_gen = powers.shape
    fine, turned = (len(p_slack) - 1) // (n - 1), np.empty((n, n_gen))
    for j in range(n):
        for g in range(n_gen):
            turned[j, g] = units.turn * out[g, 1, j]
    by_angle = np.dot(turned, units.stiffness)
    for j in range(n):
        slack = 0.0
        for start in (max(j - 1, 0), min(j, n - 2)):
            for k in range(start * fine + 1, (start + 1) * fine + 1):
                slack += 0.5 * p_slack[k] / fine
        for g in range(n_gen):
            change = 2.0 * units.unit[g] * out[g, 0, j] + by_angle[j, g]
            change += out[g, 2, j] * slack + out[g, 3, j] * (static[g, j] - powers[j, g])
            update[j, g] = powers[j, g]
            if j > 0:
                powers[j, g] += units.pace[g] * change
    track_rows(powers.reshape(1, n, n_gen), units.low, units.high, units.step)
    for j in range(n):
        for g in range(n_gen):
            update[j, g] = powers[j, g] - update[j, g]


@compiled
def _see(
    powers: Array,
    update: Array,
    omega: Array32,
    p_slack: Array32,
    given: Given,
    b: int,
    units: Units,
    seen: Array32,
) -> None:
    """Channels of a stage but its memory; see `UnrolledNetwork.sequence`."""
    n, n_gen = powers.shape
    fine, cost, static, fixed = (len(omega) - 1) // (n - 1), given.cost[b], given.static[b], given.fixed[b]
    p, last, slack = powers.T.copy(), update.T.copy(), np.empty(n)
    at_knot, below, moved = p_slack[::fine].copy(), np.empty(n, np.float32), np.empty(n)
    for j in range(n):
        first = 0 if j == 0 else (j - 1) * fine + 1
        slack[j] = p_slack[first : j * fine + 1].mean()
        for g in range(n_gen):
            most, least = -MOST, MOST
            for k in range(first, j * fine + 1):
                ratio = min(max(omega[k, g] / units.bound, -MOST), MOST)
                most, least = max(most, ratio), min(least, ratio)
            seen[g, 10, j], seen[g, 11, j] = most, least
    away, price, relative = static - p, np.empty((n_gen, n)), np.empty((n_gen, n), np.float32)
    missing = np.dot(units.compliance, away)
    for g in range(n_gen):
        channels, unit, low, high = seen[g], units.unit[g], units.low[g], units.high[g]
        _scale(p[g], 2.0 / (high - low), -(low + high) / (high - low), channels[0])
        _squash(p[g], 0.5 / unit, -0.5 * low / unit, below, channels[1])
        _squash(p[g], -0.5 / unit, 0.5 * high / unit, below, channels[2])
        _squash(away[g], 0.5 / unit, 0.0, below, channels[3])
        _squash(away[g], 0.05 / unit, 0.0, below, channels[4])
        _difference(p[g], moved)
        _scale(moved, 1.0 / units.step[g], 0.0, channels[5])
        _scale(moved, 1.0 / unit, 0.0, relative[g])
        _squash(moved, 1.0 / unit, 0.0, below, channels[6])
        _difference(static[g], moved)
        _squash(moved, 1.0 / unit, 0.0, below, channels[7])
        _squash(missing[g], 0.5 / units.turn, 0.0, below, channels[8])
        _squash(missing[g], 0.05 / units.turn, 0.0, below, channels[9])
        _squash(slack, 1.0 / unit, 0.0, below, channels[12])
        _squash(slack, 0.1 / unit, 0.0, below, channels[13])
        _squash(at_knot, 1.0 / unit, 0.0, below, channels[14])
        _squash(slack, 4.0 / unit, 0.0, below, channels[15])
        for j in range(n):
            price[g, j] = cost[1 + g] - cost[0] * channels[15, j]
        channels[15] = price[g]
        _squash(last[g], 2.0 / unit, 0.0, below, channels[17])
        _difference(fixed[g], moved)
        _squash(moved, 4.0 / unit, 0.0, below, channels[18])
    by_angle, others = np.dot(units.stiffness, price), np.dot(units.by_stiffness, relative)
    for g in range(n_gen):
        _scale(by_angle[g], 1.0 / units.stiffness[g, g], 0.0, seen[g, 16])
        _squash(others[g], 2.0, 0.0, below, seen[g, 19])


@compiled
def _difference(values: Array, found: Array) -> None:
    """To the knot before; 0 at the first."""
    found[0] = 0.0
    for j in range(1, len(values)):
        found[j] = values[j] - values[j - 1]


@compiled
def _scale(values: Floats, factor: float, offset: float, found: Array32) -> None:
    """factor * values + offset."""
    for j in range(len(values)):
        found[j] = factor * values[j] + offset


@compiled
def _squash(values: Floats, factor: float, offset: float, below: Array32, found: Array32) -> None:
    """factor * values + offset, to (-1, 1); `below` is overwritten."""
    _scale(values, factor, offset, found)
    for j in range(len(values)):
        below[j] = np.float32(1.0) + abs(found[j])
    np.divide(found, below, found)  # Python's division would check each divisor


@compiled
def _convolve(weight: Array32, values: Array32, dilation: int, taps: Array32, found: Array32) -> None:
    """Sum over each knot's neighbours at a distance, and itself; beyond both ends as at the ends.

    Args:
        weight: of knots before, here and after, (3 n_out, n_in).
        values: (n_in, n_knots).
        dilation: the distance, in knots.
        taps: (3 n_out, n_knots), overwritten: shifting what comes out is cheaper.
        found: receives the sums, (n_out, n_knots).
    """
    np.dot(weight, values, taps)
    n_out, n = found.shape
    d = min(dilation, n - 1)
    for o in range(n_out):
        before, here, after, sums = taps[o], taps[n_out + o], taps[2 * n_out + o], found[o]
        here_later, later, after_later, last = here[d:], sums[d:], after[d:], sums[n - d :]
        for j in range(d):
            sums[j] = here[j] + before[0]
        for j in range(n - d):  # slices, as Numba does not vectorise indices that may be negative
            later[j] = here_later[j] + before[j]
        for j in range(n - d):
            sums[j] += after_later[j]
        for j in range(d):
            last[j] += after[n - 1]


@compiled
def _copy(values: Array32, found: Array32) -> None:
    """What an assignment does, which Numba does not vectorise."""
    for o in range(len(found)):
        row, copied = values[o], found[o]
        for j in range(len(copied)):
            copied[j] = row[j]


@compiled
def _add(values: Array32, offsets: Array32, found: Array32) -> None:
    """Add values, (n_channels, n_knots), and a constant for each channel."""
    for o in range(len(found)):
        row, sums, offset = values[o], found[o], offsets[o]
        for j in range(len(sums)):
            sums[j] += row[j] + offset


@compiled
def _rectify(offsets: Array32, found: Array32) -> None:
    """Add a constant to each channel, (n_channels, n_knots); what is negative becomes 0."""
    for o in range(len(found)):
        sums, offset = found[o], offsets[o]
        for j in range(len(sums)):
            sums[j] = max(sums[j] + offset, np.float32(0.0))
