"""The network of `ded-dpc` without torch, whose overhead per layer would dominate a single answer.

Compiled by Numba, instance by instance. The channel comes before the knot, so that a convolution is
one product of matrices. Normalisation of the inputs is part of the first one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ded_bench.methods.dpc.inputs import Channels, n_channels
from ded_bench.methods.dpc.kernels import NetworkInputs, PowerLimits, StageWeights, correct
from ded_bench.methods.dpc.response import Response
from ded_bench.methods.ramp_follower import track
from ded_bench.problem.case import Array, Case

#: Width of the layer that constants of an instance pass through.
EMBEDDING = 64


class CompiledStages:
    """The same function as a StagedNetwork, with its state dict as arrays; the followers in float64."""

    def __init__(
        self, case: Case, response: Response, state: Mapping[str, np.ndarray], dilations: tuple[int, ...]
    ) -> None:
        n_stages = 1 + max(int(name.split(".")[1]) for name in state)
        half = 0.5 * (case.p_max - case.p_min)
        stages = [_matrices(_part(state, f"stages.{i}."), len(dilations), half) for i in range(n_stages)]
        self._weights = StageWeights(
            *(np.stack(layer).astype(np.float32) for layer in zip(*stages, strict=True))
        )
        self._limits = PowerLimits(case.p_min, case.p_max)
        self._step = case.ramp * (response.knots[1] - response.knots[0])
        self._of_power, self._dilations = response.of_power, np.array(dilations)

    def __call__(self, channels: Channels) -> Array:
        """Powers at the knots, (batch, n_knots, n_gen), pu."""
        p_gen = channels.start.swapaxes(1, 2).copy()
        seen = NetworkInputs(
            channels.constants.astype(np.float32),
            channels.sequence.swapaxes(1, 2),
            channels.free_response.swapaxes(1, 2),
        )
        for stage in range(len(self._weights.mean)):
            correct(p_gen, stage, seen, self._of_power, self._limits, self._dilations, self._weights)
            track(p_gen, self._step)
        return p_gen.swapaxes(1, 2)


def weight_shapes(
    case: Case, n_outputs: int, stages: int, width: int, n_blocks: int
) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a StagedNetwork's weights, in the order of its state dict.

    Args:
        n_outputs: of the response, per knot.
        n_blocks: how many dilations there are.
    """
    n_gen, (n_sequence, n_constants) = len(case.generators), n_channels(case)
    n_seen = n_gen + n_outputs + n_sequence
    stage: dict[str, tuple[int, ...]] = {
        "sequence_mean": (n_seen,),
        "sequence_scale": (n_seen,),
        "constants_mean": (n_constants,),
        "constants_scale": (n_constants,),
    }
    layers: dict[str, tuple[int, ...]] = {
        "first": (width, n_seen, 1, 3),
        "embed.0": (EMBEDDING, n_constants),
        "embed.2": (width * (1 + n_blocks), EMBEDDING),
        **{f"spread.{i}": (width, width, 1, 3) for i in range(n_blocks)},
        **{f"mix.{i}": (width, width, 1, 1) for i in range(n_blocks)},
        "last": (n_gen, width, 1, 1),
    }
    for name, shape in layers.items():
        stage |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    return {f"stages.{i}.{name}": shape for i in range(stages) for name, shape in stage.items()}


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _matrices(state: Mapping[str, np.ndarray], n_blocks: int, half: Array) -> StageWeights:
    """The weights of one stage, from a ResidualNetwork's state; normalisation is part of them.

    Args:
        half: half of each generator's range, pu.
    """
    blocks = range(n_blocks)
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
    """A convolution's weight (out, in, 3) as a matrix for `kernels._gather`, (out, 3 in)."""
    return weight.transpose(0, 2, 1).reshape(len(weight), -1)
