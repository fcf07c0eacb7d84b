"""DED-DPC with the paper's policy (`ded-dpc-paper`): a network that answers with powers at the knots."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc_paper.paper_inference import NumpyPaperNetwork, channels, n_channels, weight_shapes
from ded_bench.methods.options import NoOptions
from ded_bench.methods.policy_file import Scope
from ded_bench.methods.solution import Settings, Solver
from ded_bench.methods.trained_policy import TrainedPolicy, as_solver
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance

Options = NoOptions
VERSION = 1


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
    def shapes(
        scope: Scope, training: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> dict[str, tuple[int, ...]]:
        """See `TrainedPolicy.shapes`."""
        return weight_shapes(n_channels(scope.case), len(scope.case.generators))


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    return (PaperPolicy.artifact(case, regime, settings),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method.

    Raises:
        InputError: there is no policy (names the command that trains one), or it does not fit.
    """
    policy = PaperPolicy.find(case, regime, settings)
    return as_solver(policy.scope, lambda instance: policy(instance)[0])
