"""The network of `ded-dpc` without torch, whose overhead per layer would dominate a single answer.

Compiled by Numba, instance by instance. The channel comes before the knot, so that a convolution is
one product of matrices. Normalisation of the inputs is part of the first one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ded_bench.methods.dpc.channels import Channels, Response
from ded_bench.methods.knots import track
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Array32

#: How many stages there are, channels of their hidden layers, and of the layer that constants pass through.
STAGES, WIDTH, EMBEDDING = 2, 24, 64
#: With windows of three these dilations reach 16 knots to either side, in each stage.
DILATIONS = (1, 2, 4, 8)


class StageWeights(NamedTuple):
    """Weights of all stages, each with the stage as its first axis."""

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


class CompiledStages:
    """The same function as a StagedNetwork, with its state dict as arrays; the followers in float64."""

    def __init__(self, case: Case, response: Response, state: Mapping[str, np.ndarray]) -> None:
        half = 0.5 * (case.p_max - case.p_min)
        stages = [_matrices(state, f"stages.{i}.", half) for i in range(STAGES)]
        layers = (np.stack(layer).astype(np.float32) for layer in zip(*stages, strict=True))
        self._weights = StageWeights(*layers)
        self._limits = case.p_min, case.p_max, case.ramp * (response.knots[1] - response.knots[0])
        self._of_power, self._dilations = response.of_power, np.array(DILATIONS)

    def __call__(self, channels: Channels) -> Array:
        """Powers at the knots, (batch, n_knots, n_gen), pu."""
        p_gen = channels.start.swapaxes(1, 2).copy()
        constants = channels.constants.astype(np.float32)
        sequence, free = channels.sequence.swapaxes(1, 2), channels.free_response.swapaxes(1, 2)
        for stage in range(len(self._weights.mean)):
            add_corrections(
                p_gen, stage, constants, sequence, free, self._of_power, self._dilations, self._weights
            )
            track(p_gen.swapaxes(1, 2), *self._limits)
        return p_gen.swapaxes(1, 2)


def _matrices(weights: Mapping[str, np.ndarray], stage: str, half: Array) -> StageWeights:
    """The weights of one stage, from those of all; normalisation is part of them.

    Args:
        weights: by name.
        stage: how names of its own begin.
        half: half of each generator's range, pu.
    """
    state = {name.removeprefix(stage): value for name, value in weights.items() if name.startswith(stage)}
    blocks = range(len(DILATIONS))
    enter = state["embed.0.weight"] / state["constants_scale"]
    biases = np.concatenate([state["first.bias"], *(state[f"spread.{i}.bias"] for i in blocks)])
    first = state["first.weight"][:, :, 0] / state["sequence_scale"][:, None]
    biases[: len(first)] -= np.einsum("oct,c->o", first, state["sequence_mean"])
    return StageWeights(
        mean=state["sequence_mean"],
        enter=enter,
        enter_bias=state["embed.0.bias"] - enter @ state["constants_mean"],
        embed=state["embed.2.weight"],
        embed_bias=state["embed.2.bias"] + biases,
        first=_windows(first),
        spread=np.stack([_windows(state[f"spread.{i}.weight"][:, :, 0]) for i in blocks]),
        mix=np.stack([state[f"mix.{i}.weight"][:, :, 0, 0] for i in blocks]),
        mix_bias=np.stack([state[f"mix.{i}.bias"] for i in blocks]),
        last=half[:, None] * state["last.weight"][:, :, 0, 0],
        last_bias=half * state["last.bias"],
    )


def _windows(weight: np.ndarray) -> np.ndarray:
    """A convolution's weight (out, in, 3) as a matrix for `_gather`, (out, 3 in)."""
    return weight.transpose(0, 2, 1).reshape(len(weight), -1)


@inlined
def _see(p_gen: Array, sequence: Array, free_response: Array32, of_power: Array32, inputs: Array32) -> None:
    """Set what a stage sees: the schedule so far, its response and the instance, (n_inputs, n_knots)."""
    n_gen, n = p_gen.shape
    n_outputs, p32 = len(free_response), np.empty(n_gen * n, np.float32)
    for g in range(n_gen):
        copy_row(p_gen[g], p32[g * n : (g + 1) * n])
        copy_row(p_gen[g], inputs[g])
    forced = np.dot(p32, of_power)
    for i in range(n_outputs):
        for j in range(n):
            inputs[n_gen + i, j] = free_response[i, j] + forced[i * n + j]
    for i in range(len(sequence)):
        copy_row(sequence[i], inputs[n_gen + n_outputs + i])


@compiled
def add_corrections(
    p_gen: Array,
    s: int,
    constants: Array32,
    sequence: Array,
    free_response: Array32,
    of_power: Array32,
    dilations: Array,
    weights: StageWeights,
) -> None:
    """Add the corrections of one stage to the schedules of a batch, which then are targets.

    Args:
        p_gen: (batch, n_gen, n_knots), pu; receives the targets, beside P_0.
        s: the stage.
        constants: see `Channels`, (batch, n_constants).
        sequence: likewise, (batch, n_sequence, n_knots).
        free_response: likewise, (batch, n_outputs, n_knots).
        of_power: see `Response`.
        dilations: of the convolutions of each stage.
        weights: of all stages.
    """
    mean, enter, enter_bias, embed, embed_bias, first, spread, mix, mix_bias, last, last_bias = weights
    _, n_gen, n = p_gen.shape
    width, n_in = first.shape[1], mean.shape[1]
    margin = 0
    for dilation in dilations:
        margin = max(margin, dilation)
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
        for i in range(n_in):
            inputs[i, 0] = inputs[i, n + 1] = mean[s, i]
        _see(p_gen[b], sequence[b], free_response[b], of_power, inputs[:, 1 : n + 1])
        _gather(inputs, 1, input_columns)
        np.dot(first[s], input_columns, change)
        for o in range(width):
            row = hidden[o, margin : margin + n]
            for j in range(n):
                row[j] = change[o, j] + bias[o]
        for i in range(len(dilations)):
            _gather(hidden, dilations[i], columns)
            np.dot(spread[s, i], columns, inner)
            for o in range(width):
                row, own = inner[o], bias[(1 + i) * width + o]
                for j in range(n):
                    row[j] = max(row[j] + own, np.float32(0.0))
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
                p_gen[b, g, j] = p_gen[b, g, j] + corrections[g, j] + last_bias[s, g]


# Loops run over views of one row: of elements by two indices Numba makes no vector instructions.


@inlined
def _gather(padded: Array32, dilation: int, columns: Array32) -> None:
    """What a convolution sees at each knot: those `dilation` before, themselves, those after."""
    n_channels, n = len(padded), columns.shape[1]
    first = (padded.shape[1] - n) // 2 - dilation
    for tap in range(3):
        at = first + tap * dilation
        for i in range(n_channels):
            copy_row(padded[i, at : at + n], columns[tap * n_channels + i])
