"""The network of `ded-dpc` without torch, whose overhead per layer would dominate a single answer.

Arrays have the channel first and the batch last, so that a convolution is one product of matrices
and each of NumPy's loops runs over a whole channel. Normalisation and biases are part of the
matrices: each has a last column for a row of ones. What is computed on the way is kept for the next
call, since memory costs more time than arithmetic.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.dpc.follower import follow
from ded_bench.methods.dpc.inputs import Channels
from ded_bench.methods.dpc.response import Array32, Response
from ded_bench.problem.case import Array, Case

ZERO = np.float32(0.0)


class NumpyStages:
    """The same function as a StagedNetwork, with its state dict as arrays; the last follower in float64."""

    def __init__(
        self, case: Case, response: Response, state: Mapping[str, np.ndarray], dilations: tuple[int, ...]
    ) -> None:
        self._low, self._high = case.p_min[:, None, None], case.p_max[:, None, None]
        self._step = float(case.ramp_pu_per_s * (response.knots[1] - response.knots[0]))
        self._response, self._n = response, len(response.knots)
        n_stages = 1 + max(int(name.split(".")[1]) for name in state)
        half = 0.5 * (case.p_max - case.p_min)
        self._stages = [_Matrices.of(_part(state, f"stages.{i}."), dilations, half) for i in range(n_stages)]
        self._kept = threading.local()

    def __call__(self, channels: Channels) -> Array:
        """Powers at the knots, (batch, n_knots, n_gen), pu."""
        constants, sequence = channels.constants.T, channels.sequence.T
        undriven, p_gen = channels.undriven.T, channels.start.T
        for work in self._work(constants.shape[1]):
            n_gen, n_seen = len(p_gen), len(p_gen) + len(undriven)
            work.inputs[:n_gen] = p_gen
            driven = np.dot(self._response.of_power, work.inputs[:n_gen].reshape(-1, constants.shape[1]))
            np.add(undriven, driven.reshape(undriven.shape), out=work.inputs[n_gen:n_seen])
            work.inputs[n_seen:] = sequence
            targets = p_gen + work.corrections(constants)
            np.maximum(targets, self._low, out=targets)
            np.minimum(targets, self._high, out=targets)
            p_gen = follow(targets[:, 1:].T, channels.start[:, 0], self._step).T
        return p_gen.T

    def _work(self, batch: int) -> list[_Work]:
        """What this thread has for a batch of this size."""
        if getattr(self._kept, "batch", 0) != batch:
            self._kept.batch = batch
            self._kept.work = [_Work(matrices, self._n, batch) for matrices in self._stages]
        work: list[_Work] = self._kept.work
        return work


@dataclass(frozen=True, eq=False)
class _Matrices:
    """The layers of one stage; a convolution's columns are its windows: (tap, channel), then ones."""

    dilations: tuple[int, ...]
    mean: Array32  # of the inputs: what stands beyond the first and the last knot, (n_in,)
    enter: Array32  # (embedding, n_constants + 1)
    embed: Array32  # ((1 + n_blocks) width, embedding + 1): the biases of the first layer and the blocks
    first: Array32  # (width, 3 n_in + 1)
    blocks: tuple[tuple[Array32, Array32], ...]  # (width, 3 width) and (width, width + 1)
    last: Array32  # (n_gen, width + 1), pu

    @staticmethod
    def of(state: Mapping[str, np.ndarray], dilations: tuple[int, ...], half: Array) -> _Matrices:
        """From a ResidualNetwork's state; `half` is half of each generator's range, pu."""
        blocks = range(len(dilations))
        weight = state["embed.0.weight"] / state["constants_scale"]
        enter = _with_bias(weight, state["embed.0.bias"] - weight @ state["constants_mean"])
        biases = np.concatenate([state["first.bias"], *(state[f"spread.{i}.bias"] for i in blocks)])
        first = state["first.weight"][:, :, 0] / state["sequence_scale"][:, None]
        shift = -np.einsum("oct,c->o", first, state["sequence_mean"])
        return _Matrices(
            dilations,
            state["sequence_mean"],
            enter,
            _with_bias(state["embed.2.weight"], state["embed.2.bias"] + biases),
            _with_bias(_window(first), shift),
            tuple(
                (
                    _window(state[f"spread.{i}.weight"][:, :, 0]),
                    _with_bias(state[f"mix.{i}.weight"][:, :, 0, 0], state[f"mix.{i}.bias"]),
                )
                for i in blocks
            ),
            _with_bias(half[:, None] * state["last.weight"][:, :, 0, 0], half * state["last.bias"]),
        )


class _Work:
    """One stage with all that it writes to, for batches of one size."""

    def __init__(self, matrices: _Matrices, n: int, batch: int) -> None:
        self._matrices, self._shape = matrices, (n, batch)
        width, n_in, margin = len(matrices.first), len(matrices.mean), max((1, *matrices.dilations))
        padded = np.broadcast_to(matrices.mean[:, None, None], (n_in, n + 2, batch)).copy()
        self.inputs = padded[:, 1:-1]  # (n_in, n_knots, batch), to be filled before each call
        self._seen = _neighbours(padded, n, 1)
        self._seen_columns = np.ones((3 * n_in + 1, n * batch), dtype=np.float32)
        hidden = np.zeros((width, n + 2 * margin, batch), dtype=np.float32)
        self._hidden = hidden[:, margin : margin + n]
        self._near = [_neighbours(hidden, n, d) for d in matrices.dilations]
        self._columns = np.empty((3 * width, n * batch), dtype=np.float32)
        self._inner = np.ones((width + 1, n * batch), dtype=np.float32)
        self._change = np.empty((width, n * batch), dtype=np.float32)
        self._constants = np.ones((matrices.enter.shape[1], batch), dtype=np.float32)
        self._embedded = np.ones((matrices.embed.shape[1], batch), dtype=np.float32)

    def corrections(self, constants: Array) -> Array32:
        """Of the powers that the inputs hold, (n_gen, n_knots, batch), pu."""
        matrices, hidden, shape = self._matrices, self._hidden, self._hidden.shape
        self._constants[:-1] = constants
        embedded = self._embedded[:-1]
        np.dot(matrices.enter, self._constants, out=embedded)
        np.maximum(embedded, ZERO, out=embedded)
        bias = np.dot(matrices.embed, self._embedded).reshape(-1, len(hidden), 1, shape[2])
        change = self._change.reshape(shape)
        inner = self._inner[:-1]
        inner_by_knot = inner.reshape(shape)
        columns = self._columns.reshape(3, *shape)
        np.copyto(self._seen_columns[:-1].reshape(self._seen.shape), self._seen)
        np.dot(matrices.first, self._seen_columns, out=self._change)
        np.add(change, bias[0], out=hidden)
        for near, (spread, mix), own in zip(self._near, matrices.blocks, bias[1:], strict=True):
            np.copyto(columns, near)
            np.dot(spread, self._columns, out=inner)
            inner_by_knot += own
            np.maximum(inner, ZERO, out=inner)
            np.dot(mix, self._inner, out=self._change)
            hidden += change
        np.maximum(hidden, ZERO, out=inner_by_knot)
        corrections: Array32 = np.dot(matrices.last, self._inner)
        return corrections.reshape(-1, *shape[1:])


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _with_bias(weight: np.ndarray, bias: np.ndarray) -> Array32:
    """A matrix for columns that end with a one."""
    return np.hstack([weight, bias[:, None]]).astype(np.float32)


def _window(weight: np.ndarray) -> np.ndarray:
    """A convolution's weight (out, in, 3) as a matrix for `_neighbours`, (out, 3 in)."""
    return np.ascontiguousarray(weight.transpose(0, 2, 1).reshape(len(weight), -1))


def _neighbours(padded: Array32, n: int, dilation: int) -> Array32:
    """The n knots `dilation` before each, themselves, and those after: a view, (3, channels, n, batch)."""
    channels, length, batch = padded.shape
    per_channel, per_knot, per_instance = padded.strides
    return np.ndarray(
        (3, channels, n, batch),
        np.float32,
        padded,
        ((length - n) // 2 - dilation) * per_knot,
        (dilation * per_knot, per_channel, per_knot, per_instance),
    )
