"""The network of the shared policy without torch, whose overhead per layer would dominate a single answer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ded_bench.methods.dpc_shared.grid_response import FINE
from ded_bench.methods.dpc_shared.path_model import Linear, Outset, PathModel
from ded_bench.methods.dpc_shared.stage_kernels import answer
from ded_bench.methods.dpc_shared.stage_records import (
    CORRECTIONS,
    MIXED,
    SMALLEST_COST,
    Array32,
    Given,
    Units,
    Weights,
)
from ded_bench.problem.case import Array

#: Channels that a stage sees at every knot, the constants of a generator, and what a stage hands on.
N_SEQUENCE, N_CONSTANT, N_MEMORY = 20, 11, 4
#: Channels among the constants that depend on the knot: time, and a decay after t = 0.
TIMES = slice(6, 8)
DECAYS = 12.0
#: Costs whose mean is smaller are as good as free.
FREE = 1e-3
#: Machines that swing further between knots, rad², are corrected less at a time: it would excite them.
SWING = 3.0
#: A stage sees so many seconds to either side.
REACH_S = 11.0


def dilations_of(spacing_s: float) -> tuple[int, int, int]:
    """1, √n and n knots, where n knots are REACH_S."""
    n = max(REACH_S / spacing_s, 1.0)
    return 1, round(np.sqrt(n)), round(n)


def weight_shapes(stages: int, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights, in the order of its state dict: the same on every grid."""
    blocks = len(dilations_of(1.0))
    stage: dict[str, tuple[int, ...]] = {
        "first": (width, 3 * (N_SEQUENCE + N_MEMORY)),
        "constant": (width, N_CONSTANT),
        "first_bias": (width,),
        "spread": (blocks, width, 3 * width),
        "spread_bias": (blocks, width),
        "mix": (blocks, width, width + 3 * MIXED),
        "mix_bias": (blocks, width),
        "last": (CORRECTIONS + N_MEMORY, width),
        "last_bias": (CORRECTIONS + N_MEMORY,),
    }
    return {f"stages.{i}.{name}": shape for i in range(stages) for name, shape in stage.items()}


def units_of(model: PathModel) -> Units:
    """Limits of a model's case, and the units of powers in it."""
    case, response = model.case, model.response
    turn, own = model.bound * model.spacing, np.diag(response.stiffness)
    swing = own / response.network.m * model.spacing**2  # square of a machine's own swing in a knot, rad²
    return Units(
        low=case.p_min,
        high=case.p_max,
        step=model.ramp,
        unit=np.minimum(model.ramp, own * turn),
        pace=np.minimum(SWING / swing, 1.0) ** 2,
        turn=turn,
        bound=model.bound,
        stiffness=response.stiffness,
        compliance=response.compliance,
        by_stiffness=_others(response.stiffness),
        by_compliance=_others(response.compliance),
        gain=response.gain.astype(np.float32),
        shape=response.shape.astype(np.float32),
    )


def _others(matrix: Array) -> Array32:
    weights = (matrix - np.diag(np.diag(matrix))) / np.diag(matrix)[:, None]
    return weights.astype(np.float32)


def constants_of(model: PathModel, units: Units, outset: Outset) -> tuple[Array, Array]:
    """What a stage sees of a generator at all knots, (batch, N_CONSTANT, n_gen), and costs in their means.

    The entries `TIMES` are zero; they depend on the knot.
    """
    problems, (batch, n_gen) = outset.problems, outset.problems.p_initial.shape
    mean = np.maximum(problems.cost.mean(axis=1, keepdims=True), FREE)
    cost, dear = problems.cost[:, 1:], problems.cost[:, :1]
    speed = np.clip(problems.omega / units.bound, -3.0, 3.0)
    found = np.zeros((batch, N_CONSTANT, n_gen))
    found[:, 0] = (cost - dear) / np.maximum(cost + dear, FREE)
    found[:, 1], found[:, 2] = cost / mean - 1.0, dear / mean - 1.0
    found[:, 3] = (2.0 * problems.p_initial - units.low - units.high) / (units.high - units.low)
    found[:, 4], found[:, 5] = speed, speed @ units.by_stiffness.T
    own = np.diag(units.stiffness)
    found[:, 8] = np.log(0.02 * (units.high - units.low) / units.unit)
    found[:, 9] = np.log(own * units.turn / units.step)
    found[:, 10] = np.log(np.sqrt(own / model.network.m) * model.spacing)
    return found, problems.cost / mean


def static_cost(outset: Outset) -> Array:
    """Mean cost of the static dispatch, what costs are relative to, (batch,)."""
    problems, static = outset.problems, outset.static
    p_slack = problems.load[:, ::FINE].sum(axis=2) + static.sum(axis=2)
    cost = (static * problems.cost[:, None, 1:]).sum(axis=2) + problems.cost[:, :1] * np.abs(p_slack)
    return np.asarray(np.maximum(cost.mean(axis=1), SMALLEST_COST * max(1.0, static.shape[2] / 2)))


def times_of(n_knots: int) -> Array:
    """Channels that depend on the knot alone, (2, n_knots)."""
    t = np.linspace(0.0, 1.0, n_knots)
    return np.stack([t, np.exp(-DECAYS * t)])


def _taps(weights: Array32) -> Array32:
    """Those of knots before, here and after one upon another, not beside each other."""
    return np.ascontiguousarray(np.concatenate(np.split(weights, 3, axis=-1), axis=-2))


class CompiledNetwork:
    """The same function as an UnrolledNetwork, with its state dict as arrays; powers in float64."""

    def __init__(self, model: PathModel, state: Mapping[str, np.ndarray]) -> None:
        n_stages = 1 + max(int(name.split(".")[1]) for name in state)
        layer = {
            name: np.stack([state[f"stages.{i}.{name}"] for i in range(n_stages)]).astype(np.float32)
            for name in (key.removeprefix("stages.0.") for key in state if key.startswith("stages.0."))
        }
        times = times_of(len(model.response.knots)).astype(np.float32)
        self._weights = Weights(
            first=_taps(layer["first"]),
            constant=np.ascontiguousarray(layer["constant"].swapaxes(1, 2)),
            times=layer["constant"][:, :, TIMES] @ times + layer["first_bias"][:, :, None],
            spread=_taps(layer["spread"]),
            spread_bias=layer["spread_bias"],
            mix=layer["mix"],
            mix_bias=layer["mix_bias"],
            last=layer["last"],
            last_bias=layer["last_bias"],
        )
        self._model, self._units, modes = model, units_of(model), model.modes
        self._modes = modes._replace(
            step=modes.step.astype(np.float32), damping=modes.damping.astype(np.float32)
        )
        self._dilations = np.array(dilations_of(model.spacing))

    def __call__(self, outset: Outset, linear: Linear) -> Array:
        """Powers at the knots, (batch, n_knots, n_gen), pu."""
        constant, cost = constants_of(self._model, self._units, outset)
        given = Given(
            cost=cost,
            static=np.ascontiguousarray(outset.static.swapaxes(1, 2)),
            fixed=np.ascontiguousarray(outset.fixed[:, ::FINE].swapaxes(1, 2)),
            offset=linear.offset.astype(np.float32),
            slack=linear.slack.astype(np.float32),
            leverage=self._model.slack_stiffness(linear).astype(np.float32) @ self._units.shape.T,
            change=linear.change.astype(np.float32),
            state=outset.state.astype(np.float32),
            constant=np.ascontiguousarray(constant.swapaxes(1, 2), np.float32),
            scale=static_cost(outset) / np.maximum(outset.problems.cost.mean(axis=1), FREE),
        )
        powers = outset.start.copy()
        answer(powers, given, self._units, self._modes, self._dilations, self._weights)
        return powers
