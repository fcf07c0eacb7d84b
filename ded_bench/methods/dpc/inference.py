"""The network of `ded-dpc` without torch, whose overhead per layer would dominate a single answer.

Compiled by Numba, instance by instance. The channel comes before the knot, so that a convolution is
one product of matrices. Normalisation of the inputs is part of the first one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np

from ded_bench.methods.dpc.follower import track
from ded_bench.methods.dpc.inputs import Channels
from ded_bench.methods.dpc.response import Array32, Response
from ded_bench.problem.case import Array, Case


class CompiledStages:
    """The same function as a StagedNetwork, with its state dict as arrays; the followers in float64."""

    def __init__(
        self, case: Case, response: Response, state: Mapping[str, np.ndarray], dilations: tuple[int, ...]
    ) -> None:
        n_stages = 1 + max(int(name.split(".")[1]) for name in state)
        half = 0.5 * (case.p_max - case.p_min)
        stages = [_matrices(_part(state, f"stages.{i}."), len(dilations), half) for i in range(n_stages)]
        self._weights = tuple(np.stack(layer).astype(np.float32) for layer in zip(*stages, strict=True))
        step = float(case.ramp_pu_per_s * (response.knots[1] - response.knots[0]))
        self._limits = case.p_min, case.p_max, step
        self._of_power, self._dilations = response.of_power, np.array(dilations)

    def __call__(self, channels: Channels) -> Array:
        """Powers at the knots, (batch, n_knots, n_gen), pu."""
        p_gen = channels.start.swapaxes(1, 2).copy()
        sequence, undriven = channels.sequence.swapaxes(1, 2), channels.undriven.swapaxes(1, 2)
        given = channels.constants.astype(np.float32), sequence, undriven
        _answer(p_gen, *given, self._of_power, *self._limits, self._dilations, *self._weights)
        return p_gen.swapaxes(1, 2)


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _matrices(state: Mapping[str, np.ndarray], n_blocks: int, half: Array) -> tuple[np.ndarray, ...]:
    """The last arguments of `_answer` for one stage, from a ResidualNetwork's state.

    Args:
        half: half of each generator's range, pu.
    """
    blocks = range(n_blocks)
    enter = state["embed.0.weight"] / state["constants_scale"]
    biases = np.concatenate([state["first.bias"], *(state[f"spread.{i}.bias"] for i in blocks)])
    first = state["first.weight"][:, :, 0] / state["sequence_scale"][:, None]
    biases[: len(first)] -= np.einsum("oct,c->o", first, state["sequence_mean"])
    return (
        state["sequence_mean"],
        enter,
        state["embed.0.bias"] - enter @ state["constants_mean"],
        state["embed.2.weight"],
        state["embed.2.bias"] + biases,
        _windows(first),
        np.stack([_windows(state[f"spread.{i}.weight"][:, :, 0]) for i in blocks]),
        np.stack([state[f"mix.{i}.weight"][:, :, 0, 0] for i in blocks]),
        np.stack([state[f"mix.{i}.bias"] for i in blocks]),
        half[:, None] * state["last.weight"][:, :, 0, 0],
        half * state["last.bias"],
    )


def _windows(weight: np.ndarray) -> np.ndarray:
    """A convolution's weight (out, in, 3) as a matrix for `_gather`, (out, 3 in)."""
    return weight.transpose(0, 2, 1).reshape(len(weight), -1)


@numba.njit(cache=True, nogil=True)
def _answer(
    p_gen: Array,
    constants: Array32,
    sequence: Array,
    undriven: Array32,
    of_power: Array32,
    low: Array,
    high: Array,
    step: float,
    dilations: Array,
    mean: Array32,
    enter: Array32,
    enter_bias: Array32,
    embed: Array32,
    embed_bias: Array32,
    first: Array32,
    spread: Array32,
    mix: Array32,
    mix_bias: Array32,
    last: Array32,
    last_bias: Array32,
) -> None:
    """Turn the first schedules of a batch into answers, stage by stage.

    Args:
        p_gen: (batch, n_gen, n_knots), pu; receives the answers.
        constants: and the next two, see `Channels`; here the channel comes before the knot.
        of_power: see `Response`; `low`, `high`, `step`: see `follow`.
        mean: of the inputs, which stands beyond the first and the last knot; this and what follows
            has the stage as its first axis.
    """
    _, n_gen, n = p_gen.shape
    n_stages, width, n_in = len(first), first.shape[1], mean.shape[1]
    n_seen, margin = n_gen + undriven.shape[1], dilations.max()
    p32, driven = np.empty(n_gen * n, np.float32), np.empty(of_power.shape[1], np.float32)
    inputs, hidden = np.empty((n_in, n + 2), np.float32), np.zeros((width, n + 2 * margin), np.float32)
    input_columns, columns = np.empty((3 * n_in, n), np.float32), np.empty((3 * width, n), np.float32)
    inner, change = np.empty((width, n), np.float32), np.empty((width, n), np.float32)
    embedded, bias = np.empty(enter.shape[1], np.float32), np.empty(embed.shape[1], np.float32)
    corrections = np.empty((n_gen, n), np.float32)
    for b in range(len(p_gen)):
        for s in range(n_stages):
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
            np.dot(p32, of_power, driven)
            for i in range(n_gen, n_seen):
                row, own, due = inputs[i, 1 : n + 1], undriven[b, i - n_gen], driven[(i - n_gen) * n :]
                for j in range(n):
                    row[j] = own[j] + due[j]
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
                _add_and_cut(inner, bias[(1 + i) * width : (2 + i) * width])
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
            track(p_gen[b], step, p_gen[b])


# Loops run over views of one row: of elements by two indices Numba makes no vector instructions.


@numba.njit(cache=True, nogil=True)
def _copy(values: Array | Array32, out: Array32) -> None:
    """From one row to another; in float32."""
    for j in range(len(out)):
        out[j] = values[j]


@numba.njit(cache=True, nogil=True)
def _gather(padded: Array32, dilation: int, columns: Array32) -> None:
    """What a convolution sees at each knot: those `dilation` before, themselves, those after."""
    n_channels, n = len(padded), columns.shape[1]
    first = (padded.shape[1] - n) // 2 - dilation
    for tap in range(3):
        at = first + tap * dilation
        for i in range(n_channels):
            _copy(padded[i, at : at + n], columns[tap * n_channels + i])


@numba.njit(cache=True, nogil=True)
def _add_and_cut(values: Array32, bias: Array32) -> None:
    """ReLU(values + bias), in place."""
    for o in range(len(values)):
        row, own = values[o], bias[o]
        for j in range(len(row)):
            row[j] = max(row[j] + own, np.float32(0.0))
