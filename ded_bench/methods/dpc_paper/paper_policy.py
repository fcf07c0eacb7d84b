"""DED-DPC with the paper's policy (`ded-dpc-paper`): a network that answers with powers at the knots."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.options import NoOptions
from ded_bench.methods.solution import Settings, Solver
from ded_bench.methods.trained_policy import TrainedPolicy, as_solver
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance

Options = NoOptions
VERSION = 1
#: Output channels of the hidden layers, and the window of each layer (paper, section on the implementation).
FILTERS, WINDOWS = 30, (5, 10, 5)
ZERO = np.float32(0.0)


class PaperPolicy(TrainedPolicy):
    """The paper's network, trained by its recipe."""

    method = "ded-dpc-paper"

    @functools.cached_property
    def _network(self) -> Network:
        return Network(self.scope.case)

    @functools.cached_property
    def _numpy(self) -> NumpyPaperNetwork:
        return NumpyPaperNetwork(self.weights)

    def answers(self, instances: Sequence[Instance]) -> Array:
        """See `TrainedPolicy.answers`."""
        case = self.scope.case
        powers = self._numpy(channels(self._network, instances, self.knots))
        return np.minimum(np.maximum(powers, case.p_min), case.p_max)  # again, in float64

    @staticmethod
    def shapes(case: Case, training: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """See `TrainedPolicy.shapes`; in the order of a PaperNetwork's state dict."""
        inputs, n_gen = n_channels(case), len(case.generators)
        shapes: dict[str, tuple[int, ...]] = {"mean": (inputs, 1), "scale": (inputs, 1)}
        shapes |= {"p_min": (n_gen, 1), "p_max": (n_gen, 1)}
        sizes = (inputs, FILTERS, FILTERS, n_gen)
        for i, window in enumerate(WINDOWS):
            place = f"layers.{3 * i + 1}"  # after the padding; a ReLU follows
            shapes |= {f"{place}.weight": (sizes[i + 1], sizes[i], window), f"{place}.bias": (sizes[i + 1],)}
        return shapes


artifacts = PaperPolicy.artifacts


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method.

    Raises:
        InputError: there is no policy (names the command that trains one), or it does not fit.
    """
    policy = PaperPolicy.find(case, regime, settings)
    return as_solver(policy, lambda instance: policy.answers([instance])[0])


def n_channels(case: Case) -> int:
    """Number of channels: loads, costs with the slack's, x_0 = (θ without the slack's, P_s, ω), P_0."""
    return len(case.loads) + (1 + len(case.generators)) + case.n_bus + 2 * len(case.generators)


def channels(network: Network, instances: Sequence[Instance], knots: Array) -> Array:
    """ζ as channels over the knots, constants repeated, in the units of the files.

    Args:
        network: of the instances' case.
        knots: times, (n_knots,), s.

    Returns:
        Shape (batch, n_channels, n_knots): pu, cost per pu, rad, pu, rad/s, pu.

    Raises:
        SimulationError: an instance has no angles at t = 0.
    """
    case = network.case
    theta = np.stack([network.initial_angles(instance) for instance in instances])
    constant = np.concatenate(
        [
            [[i.cost_slack(case), *i.cost_gen(case)] for i in instances],
            theta[:, network.unknown],
            network.injections(theta)[:, [network.slack]],
            [i.omega_initial(case) for i in instances],
            [i.p_initial(case) for i in instances],
        ],
        axis=1,
    )
    repeated = np.broadcast_to(constant[:, :, None], (*constant.shape, len(knots)))
    p_load = np.stack([i.p_load(case, knots) for i in instances])
    return np.concatenate([p_load.transpose(0, 2, 1), repeated], axis=1)


class NumpyPaperNetwork:
    """The same function as a PaperNetwork with these weights (see `PaperPolicy.shapes`)."""

    def __init__(self, state: Mapping[str, np.ndarray]) -> None:
        self._mean, self._scale = state["mean"], 1.0 / state["scale"]
        self._low, self._half = state["p_min"], 0.5 * (state["p_max"] - state["p_min"])
        weights = [value for name, value in state.items() if name.endswith(".weight")]  # (out, in, window)
        matrices = [w.transpose(0, 2, 1).reshape(len(w), -1) for w in weights]
        biases = [value[:, None] for name, value in state.items() if name.endswith(".bias")]
        self._layers = list(zip(WINDOWS, matrices, biases, strict=True))

    def __call__(self, channels: Array) -> Array:
        """See `PaperNetwork.forward`."""
        h = (channels.astype(np.float32) - self._mean) * self._scale
        for i, (window, weight, bias) in enumerate(self._layers):
            if i:
                np.maximum(h, ZERO, out=h)
            h = np.matmul(weight, _windows(h, window))
            h += bias
        np.tanh(h, out=h)
        h += 1.0
        return np.asarray((self._low + self._half * h).swapaxes(1, 2), dtype=np.float64)


def _windows(x: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    """What a convolution sees at each knot, zeros outside, (batch, window * width, n)."""
    batch, width, n = x.shape
    before = (window - 1) // 2
    padded = np.zeros((batch, width, n + window - 1), dtype=np.float32)
    padded[:, :, before : before + n] = x
    per_instance, per_channel, per_knot = padded.strides
    strides = per_instance, per_knot, per_channel, per_knot
    return np.ndarray((batch, window, width, n), np.float32, padded, strides=strides).reshape(batch, -1, n)
