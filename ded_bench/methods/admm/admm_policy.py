"""DED-DPC with shared weights (`ded-dpc-shared`): a few iterations of ADMM whose settings are learned.

The weights are shared by generators and knots, so that they do not depend on the grid. Bounds, ramps
and P_0 hold for any weights. See `unrolled_inference` for the iterations.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.admm.admm_inference import CompiledIterations, weight_shapes
from ded_bench.methods.admm.drawn_problems import Problems
from ded_bench.methods.admm.grid_response import GridResponse
from ded_bench.methods.admm.path_model import Linear, Outset, PathModel
from ded_bench.methods.artifact import Artifact
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
from ded_bench.plants.lossless.network import PowerFlowError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

if TYPE_CHECKING:
    from ded_bench.methods.admm.admm_iterations import UnrolledIterations

METHOD = "ded-dpc-shared"
SETTINGS: dict[str, dict[str, Any]] = {"default": {}}
#: Instances answered at a time.
CHUNK = 50


@dataclass(frozen=True, eq=False)
class SharedPolicy:
    """Learned settings of the iterations with all that is needed to apply them."""

    scope: Scope
    weights: Weights
    training: dict[str, Any]  # facts of the training; `iterations` and `margin` shape answers

    @staticmethod
    def of(scope: Scope, unrolled: UnrolledIterations, training: dict[str, Any]) -> SharedPolicy:
        """The policy that was trained in torch."""
        facts = training | {"iterations": len(unrolled.start)}
        return SharedPolicy(scope, weights_of(unrolled), facts)

    @functools.cached_property
    def model(self) -> PathModel:
        """The grid as the policy sees it; its bound is tighter by the margin."""
        case = self.scope.case
        response = GridResponse.make(case, case.knot_times(self.scope.horizon_s))
        bound = case.omega_bound(self.scope.regime) * (1.0 - float(self.training.get("margin", 0.0)))
        return PathModel(case, bound, response)

    @property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return self.model.response.knots

    @functools.cached_property
    def _compiled(self) -> CompiledIterations:
        return CompiledIterations(self.model, self.weights, self.training["iterations"])

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon, or its loads cannot be served.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        return [Schedule(self.knots, p) for p in self.powers(self.problems(batch))] if batch else []

    def problems(self, instances: Sequence[Instance]) -> Problems:
        """Instances as arrays; raises as a call does."""
        self.scope.check(instances)
        try:
            return Problems.of(self.scope.case, instances, self.model.response.fine)
        except PowerFlowError as error:
            raise InputError(f"instance {instances[0].id}", "initial", str(error)) from None

    def powers(self, problems: Problems) -> Array:
        """Generator powers at the knots, shape (batch, n_knots, n_gen), pu, from stacked arrays."""
        if len(problems) > CHUNK:
            starts = range(0, len(problems), CHUNK)
            return np.concatenate([self.powers(problems[i : i + CHUNK]) for i in starts])
        outset = self.model.outset(problems)
        return self.answer(outset, self.model.linearise(outset, self.model.start_path(outset)))

    def answer(self, outset: Outset, linear: Linear) -> Array:
        """As `powers`, where the grid along the path of the first schedule is known."""
        return self._compiled(outset, linear, outset.start)

    def save(self, path: Path) -> None:
        """Write weights and header."""
        write_policy(path, METHOD, self.scope, self.weights, self.training)

    @staticmethod
    def load(path: str | Path, case: Case, regime: str) -> SharedPolicy:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, METHOD, case, regime)
        iterations = training.get("iterations")
        if not (isinstance(iterations, int) and 0 < iterations < 1000):
            raise InputError(path, "training", "number of iterations is missing or mistyped")
        return SharedPolicy(scope, checked_weights(arrays, weight_shapes(), path), training)

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.weights)


def find_policy(case: Case, regime: str, settings: Settings) -> SharedPolicy:
    """Load the policy that settings and folders to search name.

    Raises:
        InputError: there is none yet (names the command that trains one), or it does not fit.
    """
    return SharedPolicy.load(find_policy_file(METHOD, case, regime, settings), case, regime)


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    path = find_policy_file(METHOD, case, regime, settings)
    return (Artifact("policy", METHOD, SharedPolicy.load(path, case, regime).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method."""
    return method(find_policy(case, regime, settings))
