"""What Numba compiles for `ded-dpc`, in one file; the ramp follower is called between stages.

Its cache on disk notices that a function's own file changed, not that a function which it calls did.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.dpc.response import Array32
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

Indices = NDArray[np.int_]

#: Costs whose sum is smaller are as good as free.
SMALLEST_SUM = 1e-9


class PowerLimits(NamedTuple):
    """Bounds of the generators."""

    p_min: Array  # (n_gen,), pu, as the next
    p_max: Array


class InstanceArrays(NamedTuple):
    """What channels are computed from; see `inputs.Inputs`."""

    cost: Array
    p_initial: Array
    state: Array


class ChannelArrays(NamedTuple):
    """Receives channels; the channel comes before the knot. See `inputs.Channels`."""

    p_load: Array  # loads at the nodes, (batch, n_load, n_nodes), pu
    sequence: Array  # (batch, n_sequence, n_knots)
    constants: Array  # (batch, n_constants)
    start: Array  # (batch, n_gen, n_knots), pu


class NetworkInputs(NamedTuple):
    """What all stages see; the channel comes before the knot. See `inputs.Channels`."""

    constants: Array32  # (batch, n_constants)
    sequence: Array  # (batch, n_sequence, n_knots)
    free_response: Array32  # (batch, n_outputs, n_knots)


class StageWeights(NamedTuple):
    """Weights of all stages, each with the stage as its first axis; made by `inference`."""

    mean: Array32  # of the inputs, which stands beyond the first and the last knot
    enter: Array32
    enter_bias: Array32
    embed: Array32
    embed_bias: Array32
    first: Array32
    spread: Array32
    mix: Array32
    mix_bias: Array32
    last: Array32
    last_bias: Array32


@compiled
def fill_loads(load: Array, nodes: Array, p_load: Array, sequence: Array) -> None:
    """Loads of a batch at the nodes, then at the knots and their bends; see `ChannelArrays`."""
    n_load = p_load.shape[1]
    for b in range(len(p_load)):
        for i in range(n_load):
            at_knots, bends = sequence[b, i], sequence[b, n_load + i]
            _loads_and_bends(load[b, i], nodes, p_load[b, i], at_knots, bends)


@compiled
def fill_machines(
    given: InstanceArrays, static: Array, limits: PowerLimits, dispatch: bool, channels: ChannelArrays
) -> None:
    """What else a batch's channels hold, instance by instance; see `inputs.Channels.of`.

    Args:
        static: static dispatch at the knots, (batch, n_knots, n_gen), pu.
    """
    p_load, sequence, constants, start = channels
    n_gen, n_load = len(limits.p_min), p_load.shape[1]
    for b in range(len(p_load)):
        for j in range(start.shape[2]):
            p_slack = 0.0
            for i in range(n_load):
                p_slack -= sequence[b, i, j]
            for g in range(n_gen):
                p_gen = static[b, j, g]
                p_slack -= p_gen
                sequence[b, 2 * n_load + g, j] = p_gen
                start[b, g, j] = p_gen if dispatch else 0.5 * (limits.p_min[g] + limits.p_max[g])
            sequence[b, 2 * n_load + n_gen, j] = p_slack
        for g in range(n_gen):
            start[b, g, 0] = given.p_initial[b, g]
        _constants(given.cost[b], given.p_initial[b], given.state[b, n_gen:], constants[b])


@compiled
def _loads_and_bends(segments: Array, nodes: Array, p_load: Array, at_knots: Array, bends: Array) -> None:
    """A load at the nodes and at the knots, and how far its mean between two knots is off the chord; pu.

    Every second node is a knot. The bend tells where between two knots the load changes its slope.

    Args:
        segments: see `inputs.Inputs`.
    """
    n_segments, initial, spacing = len(segments), segments[0, 1], nodes[2] - nodes[0]
    following, before = 0, 0.0  # next segment, and ∫ (load - initial) dt up to the start of this one
    start = rise = slope = area_before = rise_before = 0.0
    for k in range(len(nodes)):
        while following < n_segments and segments[following, 0] <= nodes[k]:
            width = segments[following, 0] - start
            before += width * (rise + 0.5 * slope * width)
            start, slope = segments[following, 0], segments[following, 2]
            rise = segments[following, 1] - initial
            following += 1
        since = nodes[k] - start
        change = rise + slope * since
        p_load[k] = initial + change
        if k % 2 == 0:
            area = before + 0.5 * since * (rise + change)
            at_knots[k // 2] = p_load[k]
            bends[k // 2] = (area - area_before) / spacing - 0.5 * (change + rise_before) if k else 0.0
            area_before, rise_before = area, change


@compiled
def _constants(cost: Array, p_initial: Array, omega: Array, constants: Array) -> None:
    """Ratios of costs, then P_0 and ω(0).

    Each cost in all costs, each generator's in its and the slack's, and of each pair of generators the
    difference in the sum.
    """
    n_gen, k, total = len(p_initial), 0, 0.0
    for i in range(1 + n_gen):
        total += cost[i]
    for i in range(1 + n_gen):
        constants[k] = cost[i] / max(total, SMALLEST_SUM)
        k += 1
    for i in range(1, 1 + n_gen):
        constants[k] = cost[i] / max(cost[i] + cost[0], SMALLEST_SUM)
        k += 1
    for i in range(1, 1 + n_gen):
        for j in range(i + 1, 1 + n_gen):
            constants[k] = (cost[i] - cost[j]) / max(cost[i] + cost[j], SMALLEST_SUM)
            k += 1
    for g in range(n_gen):
        constants[k + g], constants[k + n_gen + g] = p_initial[g], omega[g]


@compiled
def correct(
    p_gen: Array,
    s: int,
    seen: NetworkInputs,
    of_power: Array32,
    limits: PowerLimits,
    dilations: Array,
    weights: StageWeights,
) -> None:
    """Add the corrections of one stage to the schedules of a batch, within bounds; then they are targets.

    Args:
        p_gen: (batch, n_gen, n_knots), pu; receives the targets, beside P_0.
        s: the stage.
        seen: what all stages see.
        of_power: see `response.Response`.
        limits: bounds of the generators.
        dilations: of the convolutions of each stage.
        weights: of all stages.
    """
    mean, enter, enter_bias, embed, embed_bias, first, spread, mix, mix_bias, last, last_bias = weights
    constants, sequence, free_response = seen
    low, high = limits
    _, n_gen, n = p_gen.shape
    width, n_in = first.shape[1], mean.shape[1]
    n_seen, margin = n_gen + free_response.shape[1], dilations.max()
    p32, forced = np.empty(n_gen * n, np.float32), np.empty(of_power.shape[1], np.float32)
    inputs, hidden = np.empty((n_in, n + 2), np.float32), np.zeros((width, n + 2 * margin), np.float32)
    input_columns, columns = np.empty((3 * n_in, n), np.float32), np.empty((3 * width, n), np.float32)
    inner, change = np.empty((width, n), np.float32), np.empty((width, n), np.float32)
    embedded, bias = np.empty(enter.shape[1], np.float32), np.empty(embed.shape[1], np.float32)
    corrections = np.empty((n_gen, n), np.float32)
    for b in range(len(p_gen)):
        np.dot(enter[s], constants[b], embedded)
        for i in range(len(embedded)):
            embedded[i] = max(embedded[i] + enter_bias[s, i], np.float32(0.0))
        np.dot(embed[s], embedded, bias)
        for i in range(len(bias)):
            bias[i] += embed_bias[s, i]
        # what the stage sees: the schedule so far, its response, the instance
        for i in range(n_in):
            inputs[i, 0] = inputs[i, n + 1] = mean[s, i]
        for g in range(n_gen):
            _copy(p_gen[b, g], p32[g * n : (g + 1) * n])
            _copy(p_gen[b, g], inputs[g, 1 : n + 1])
        np.dot(p32, of_power, forced)
        for i in range(n_gen, n_seen):
            row, output = inputs[i, 1 : n + 1], i - n_gen
            free, due = free_response[b, output], forced[output * n :]
            for j in range(n):
                row[j] = free[j] + due[j]
        for i in range(n_seen, n_in):
            _copy(sequence[b, i - n_seen], inputs[i, 1 : n + 1])
        # its corrections
        _gather(inputs, 1, input_columns)
        np.dot(first[s], input_columns, change)
        for o in range(width):
            row = hidden[o, margin : margin + n]
            for j in range(n):
                row[j] = change[o, j] + bias[o]
        for i in range(len(dilations)):
            _gather(hidden, dilations[i], columns)
            np.dot(spread[s, i], columns, inner)
            _add_and_rectify(inner, bias[(1 + i) * width : (2 + i) * width])
            np.dot(mix[s, i], inner, change)
            for o in range(width):
                row = hidden[o, margin : margin + n]
                for j in range(n):
                    row[j] += change[o, j] + mix_bias[s, i, o]
        for o in range(width):
            row = hidden[o, margin : margin + n]
            for j in range(n):
                inner[o, j] = max(row[j], np.float32(0.0))
        np.dot(last[s], inner, corrections)
        for g in range(n_gen):
            for j in range(1, n):
                target = p_gen[b, g, j] + corrections[g, j] + last_bias[s, g]
                p_gen[b, g, j] = min(max(target, low[g]), high[g])


# Loops run over views of one row: of elements by two indices Numba makes no vector instructions.


@compiled
def _copy(values: Array | Array32, out: Array32) -> None:
    """From one row to another; in float32."""
    for j in range(len(out)):
        out[j] = values[j]


@compiled
def _gather(padded: Array32, dilation: int, columns: Array32) -> None:
    """What a convolution sees at each knot: those `dilation` before, themselves, those after."""
    n_channels, n = len(padded), columns.shape[1]
    first = (padded.shape[1] - n) // 2 - dilation
    for tap in range(3):
        at = first + tap * dilation
        for i in range(n_channels):
            _copy(padded[i, at : at + n], columns[tap * n_channels + i])


@compiled
def _add_and_rectify(values: Array32, bias: Array32) -> None:
    """ReLU(values + bias), in place."""
    for o in range(len(values)):
        row, own = values[o], bias[o]
        for j in range(len(row)):
            row[j] = max(row[j] + own, np.float32(0.0))


class OmegaModel(NamedTuple):
    """What ω does under powers and loads linear between points; deviations from rest advance by `advance`."""

    advance: Array  # (n_psi, n_psi), over one point; ω is the first n_gen of the deviations
    of_delta: Array  # (n_psi, n_gen), per rad of δθ at t = 0
    of_power: Array  # (n_psi, n_gen), per pu that a power changes from one point to the next
    of_load: Array  # (n_psi, n_load), likewise


@compiled
def predict(
    load: Array, state: Array, p_gen: Array, model: OmegaModel, limit: Array, spacing: float, omega: Array
) -> bool:
    """What the linearised grid does to ω under schedules.

    Args:
        load: segments of a batch, see `inputs.Inputs`; likewise `state`.
        p_gen: (batch, n_gen, n_knots), pu.
        model: the linearised grid.
        limit: of |ω| at the points, (n_points,), rad/s; a whole number of points makes an interval of knots.
        spacing: of the points, s.
        omega: receives ω at the points, (batch, n_gen, n_points), rad/s.

    Returns:
        Whether any |ω| exceeds its limit.
    """
    n_psi, n_gen = model.of_power.shape
    n_points, parts, exceeds = len(limit), (len(limit) - 1) // (p_gen.shape[2] - 1), False
    pushes, psi, power = np.empty((n_points, n_psi)), np.empty(n_psi), np.empty(n_psi)
    for b in range(len(p_gen)):
        _load_pushes(load[b], model.of_load, spacing, pushes)
        for i in range(n_psi):
            psi[i] = state[b, n_gen + i] if i < n_gen else 0.0
            for g in range(n_gen):
                psi[i] += model.of_delta[i, g] * state[b, g]
        for k in range(n_points):
            if k and (k - 1) % parts == 0:
                j = (k - 1) // parts
                power[:] = 0.0
                for g in range(n_gen):
                    change = (p_gen[b, g, j + 1] - p_gen[b, g, j]) / parts
                    for i in range(n_psi):
                        power[i] += model.of_power[i, g] * change
            if k:
                push = pushes[k]
                for i in range(n_psi):
                    push[i] += power[i]
                    for m in range(n_psi):
                        push[i] += model.advance[i, m] * psi[m]
                psi[:] = push
            for g in range(n_gen):
                omega[b, g, k] = psi[g]
                exceeds |= abs(psi[g]) > limit[k]
    return exceeds


@compiled
def _load_pushes(load: Array, of_load: Array, spacing: float, pushes: Array) -> None:
    """What changes of an instance's loads from one point to the next add to the state, (n_points, n_psi)."""
    pushes[:] = 0.0
    for i in range(len(load)):
        segments, following = load[i], 0
        before = segments[0, 1]
        for k in range(len(pushes)):
            t = k * spacing
            while following < len(segments) and segments[following, 0] <= t:
                following += 1
            value = segments[following - 1, 1] + segments[following - 1, 2] * (t - segments[following - 1, 0])
            if value != before:
                for n in range(len(of_load)):
                    pushes[k, n] += of_load[n, i] * (value - before)
                before = value
