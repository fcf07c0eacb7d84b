"""DED-DPC (`ded-dpc`): a network looks at what a schedule would do and corrects it, in stages.

Where the result would still exceed the bound on |ω|, the least change that mends it follows. Bounds, ramps
and P_0 hold for any weights.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc.bound_keeper import BoundKeeper
from ded_bench.methods.dpc.inference import CompiledStages, weight_shapes
from ded_bench.methods.dpc.inputs import Channels, Inputs
from ded_bench.methods.dpc.response import Response
from ded_bench.methods.dpc.variants import SETTINGS as SETTINGS
from ded_bench.methods.policy_file import (
    Scope,
    Weights,
    checked_weights,
    find_policy_file,
    read_policy,
    weights_fingerprint,
    weights_of,
    write_policy,
)
from ded_bench.methods.policy_solver import method
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

if TYPE_CHECKING:
    from ded_bench.methods.dpc.policy_network import StagedNetwork

METHOD = "ded-dpc"
#: Instances that one thread takes at a time.
CHUNK = 50


@dataclass(frozen=True, eq=False)
class DispatchPolicy:
    """A trained network with all that is needed to apply it."""

    scope: Scope
    response: Response  # what the network looks at
    weights: Weights
    training: dict[str, Any]  # facts of the training, and `stages`, `width`, `dilations` of the network

    @staticmethod
    def of(scope: Scope, network: StagedNetwork, training: dict[str, Any]) -> DispatchPolicy:
        """The policy of a network in torch."""
        return DispatchPolicy(scope, network.response, weights_of(network), training | network.shape)

    @property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return self.response.knots

    @functools.cached_property
    def _compiled(self) -> CompiledStages:
        return CompiledStages(self.scope.case, self.response, self.weights, tuple(self.training["dilations"]))

    @functools.cached_property
    def _keeper(self) -> BoundKeeper:
        return BoundKeeper.make(self.scope.case, self.scope.regime, self.knots)

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self.scope.check(batch)
        if not batch:
            return []
        return [Schedule(self.knots, p) for p in self.powers(Inputs.of(self.scope.case, batch))]

    def powers(self, inputs: Inputs, threads: int = 1) -> Array:
        """Generator powers at the knots, shape (batch, n_knots, n_gen), pu, from stacked arrays."""
        if len(inputs) <= CHUNK:
            return self._keeper(inputs, self.network_powers(inputs))
        parts = [inputs[start : start + CHUNK] for start in range(0, len(inputs), CHUNK)]
        if threads == 1:
            return np.concatenate([self.powers(part) for part in parts])
        with ThreadPoolExecutor(threads) as pool:
            return np.concatenate(list(pool.map(self.powers, parts)))

    def network_powers(self, inputs: Inputs) -> Array:
        """What the network alone answers, as `powers`."""
        return self._compiled(self.channels(inputs))

    def channels(self, inputs: Inputs) -> Channels:
        """What the network reads of instances."""
        return Channels.of(self.scope.case, inputs, self.response, self.training.get("prior", True))

    def save(self, path: Path) -> None:
        """Write weights, normalisation and header."""
        write_policy(path, METHOD, self.scope, self.weights, self.training)

    @staticmethod
    def load(path: str | Path, case: Case, regime: str) -> DispatchPolicy:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, METHOD, case, regime)
        stages, width, dilations = (training.get(name) for name in ("stages", "width", "dilations"))
        if not (isinstance(stages, int) and isinstance(width, int) and isinstance(dilations, list)):
            raise InputError(path, "training", "lacks the network's stages, width and dilations")
        if not all(isinstance(d, int) and 0 < d < case.n_knots for d in dilations):
            raise InputError(path, "training", "has dilations that are no numbers of knots")
        layers = {name for name in arrays if ".mix." in name and name.endswith(".bias")}
        widths = {arrays[name].shape for name in layers} | {(width,)}
        if len(layers) != stages * len(dilations) or len(widths) != 1 or not layers:
            raise InputError(path, "training", "has another width or depth than the weights")
        if not isinstance(training.get("prior", True), bool):
            raise InputError(path, "training", "has a prior that is neither true nor false")
        response = Response.make(case, case.knot_times(scope.horizon_s))
        shapes = weight_shapes(case, response.n_outputs, stages, width, len(dilations))
        return DispatchPolicy(scope, response, checked_weights(arrays, shapes, path), training)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.weights)


def find_policy(case: Case, regime: str, settings: Settings) -> DispatchPolicy:
    """Return the policy given in the settings, else the first one in the folders to search.

    Raises:
        InputError: there is none (names the command that trains one), or it does not fit.
    """
    return DispatchPolicy.load(find_policy_file(METHOD, case, regime, settings), case, regime)


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    path = find_policy_file(METHOD, case, regime, settings)
    return (Artifact("policy", METHOD, DispatchPolicy.load(path, case, regime).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method."""
    return method(find_policy(case, regime, settings))
