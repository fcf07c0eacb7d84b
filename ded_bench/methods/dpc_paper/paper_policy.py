"""DED-DPC with the paper's policy (`ded-dpc-paper`): a network that answers with powers at the knots."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc_paper.paper_features import channels, n_channels
from ded_bench.methods.dpc_paper.paper_inference import NumpyPaperNetwork, weight_shapes
from ded_bench.methods.policy_file import (
    Scope,
    Weights,
    checked_weights,
    find_policy_file,
    read_policy,
    weights_fingerprint,
    write_policy,
)
from ded_bench.methods.policy_solver import method
from ded_bench.methods.solution import Settings, Solver
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

METHOD = "ded-dpc-paper"
#: How the policy is trained, by slug: fields of `paper_training.Recipe`. The default is the paper's recipe
#: and nothing else; `averaged` adds what makes it better without changing loss, network or data.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "averaged": {"epochs": 900, "batch": 8, "normalise": True, "averaging": 0.9995, "held_out": 0.2},
}


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained network with all that is needed to apply it."""

    scope: Scope
    weights: Weights
    training: dict[str, Any]

    @functools.cached_property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return self.scope.case.knot_times(self.scope.horizon_s)

    @functools.cached_property
    def _grid(self) -> Network:
        return Network(self.scope.case)

    @functools.cached_property
    def _numpy(self) -> NumpyPaperNetwork:
        return NumpyPaperNetwork(self.weights)

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon.
            PowerFlowError: an instance has no angles at t = 0.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self.scope.check(batch)
        case = self.scope.case
        powers = self._numpy(channels(self._grid, batch, self.knots))
        powers = np.minimum(np.maximum(powers, case.p_min), case.p_max)  # again, in float64
        return [Schedule(self.knots, p) for p in powers]

    def save(self, path: Path) -> None:
        """Write weights, normalisation and header."""
        write_policy(path, METHOD, self.scope, self.weights, self.training)

    @staticmethod
    def load(path: str | Path, case: Case, regime: str) -> Policy:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, METHOD, case, regime)
        shapes = weight_shapes(n_channels(case), len(case.generators))
        return Policy(scope, checked_weights(arrays, shapes, path), training)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.weights)


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    path = find_policy_file(METHOD, case, regime, settings)
    return (Artifact("policy", METHOD, Policy.load(path, case, regime).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method.

    Raises:
        InputError: there is no policy (names the command that trains one), or it does not fit.
    """
    return method(Policy.load(find_policy_file(METHOD, case, regime, settings), case, regime))
