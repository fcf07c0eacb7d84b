"""Learned ADMM (`ded-admm`): a few iterations whose penalties are learned; see `admm_inference`.

The weights are shared by generators and knots, so that they do not depend on the grid. Bounds, ramps
and P_0 hold for any weights. More iterations, along the trajectory of the answer, improve it. Islands have
iterations of their own, see `methods.island`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.admm.admm_inference import NODES, SETTINGS, CompiledIterations
from ded_bench.methods.admm.modal_grid import ModalGrid
from ded_bench.methods.admm.problems import problems_of
from ded_bench.methods.island.island_policy import IslandPolicy, IslandSolver
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Artifact, Settings, Solver
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.trained_policy import TrainedPolicy, as_solver
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.lossless_case import lossless

VERSION = 1
#: Weights that were learned for fewer iterations take long steps and do not serve many.
LEARNED_FOR = 10
#: By what part of it further iterations keep away from the bound on |ω|, or by half the learned margin where
#: that is more: their schedules ride it, and the linearised grid errs (studies/admm.md).
MARGIN = 0.01


@dataclass(frozen=True)
class Options:
    """Parameters of `ded-admm`."""

    iterations: int = option(0, "iterations beyond the policy's own", lowest=0)
    margin: float | None = option(None, "part of the bound left free; none: as learned", lowest=0, below=1)


class AdmmPolicy(TrainedPolicy):
    """Learned settings of iterations; `training` has their number, and perhaps a `margin` of the bound."""

    method = "ded-admm"
    deciding = ("iterations", "margin")

    @functools.cached_property
    def grid(self) -> ModalGrid:
        """The grid as the policy sees it; its bound is tighter by the margin."""
        case, margin = self.scope.case, float(self.training.get("margin", 0.0))
        return ModalGrid(case, case.omega_bound(self.scope.regime) * (1.0 - margin), self.scope.horizon_s)

    @functools.cached_property
    def _compiled(self) -> CompiledIterations:
        nodes, iterations = self.weights["nodes"], self.training["iterations"]
        return CompiledIterations(self.grid, self.grid.bound, nodes, iterations)

    def further(self, iterations: int, margin: float | None = None) -> CompiledIterations:
        """So many iterations to go on with; their weights are the learned or those where training starts."""
        few, nodes = self.training["iterations"] < LEARNED_FOR, self.weights["nodes"]
        margin = max(MARGIN, 0.5 * self.training.get("margin", 0.0)) if margin is None else margin
        bound = (1.0 - margin) * self.scope.case.omega_bound(self.scope.regime)
        return CompiledIterations(self.grid, bound, np.zeros_like(nodes) if few else nodes, iterations)

    def answers(self, instances: Sequence[Instance]) -> Array:
        """See `TrainedPolicy.answers`."""
        return self.powers(self.problems(instances))

    def problems(self, instances: Sequence[Instance]) -> StackedInstances:
        """Instances within the scope as arrays; InputError if one has angles without an equilibrium."""
        try:
            return problems_of(self.scope.case, instances, self.grid.points)
        except SimulationError as error:
            raise InputError(f"instance {instances[0].id}", "initial", str(error)) from None

    def powers(self, problems: StackedInstances, further: CompiledIterations | None = None) -> Array:
        """Generator powers at the knots, shape (batch, n_knots, n_gen), pu.

        Args:
            problems: to answer.
            further: go on with these, on the grid linearised along the trajectory of the policy's answer.
        """
        grid = self.grid
        start = grid.start(problems)
        linear = grid.along_first(start)
        answer = self._compiled(start, linear, start.schedule)
        if further is None:
            return answer
        return further(start, grid.along(start, grid.respond(answer, start, linear)[0]), answer)

    @staticmethod
    def shapes(case: Case, training: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """See `TrainedPolicy.shapes`."""
        iterations, margin = training.get("iterations"), training.get("margin", 0.0)
        if not (isinstance(iterations, int) and 0 < iterations < 1000):
            raise ValueError("number of iterations is missing or mistyped")
        if not (isinstance(margin, int | float) and 0.0 <= margin < 1.0):
            raise ValueError("margin is no fraction")
        return {"nodes": (NODES, len(SETTINGS))}  # the same on every grid


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that answers."""
    own = replace(settings, model="")  # of others that are asked for along with it
    return (AdmmPolicy if case.slack is not None else IslandPolicy).artifacts(case, regime, own)


def check(case: Case, settings: Settings) -> None:
    """Raise InputError on an island that is given a margin, or beside a slack without a lossless network."""
    if case.slack is not None:
        lossless(case)
    if case.slack is None and read_options(Options, settings.options).margin is not None:
        raise InputError("--set", "margin", "policies of islands have none but the learned")


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method.

    Raises:
        InputError: there is no policy (names the command that trains one), or it does not fit.
    """
    options, own = read_options(Options, settings.options), replace(settings, model="")
    iterations, margin = options.iterations, options.margin
    if case.slack is None:
        return IslandSolver(IslandPolicy.find(case, regime, own), iterations)
    policy = AdmmPolicy.find(case, regime, own)
    if margin is not None:
        policy = replace(policy, training={**policy.training, "margin": margin})
    further = policy.further(iterations, margin) if iterations else None

    def answer(instance: Instance) -> Array:
        return np.asarray(policy.powers(policy.problems([instance]), further)[0])

    return as_solver(policy, answer, iterations)
