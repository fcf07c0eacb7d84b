"""DED-DPC (`ded-dpc`): a network looks at what a schedule would do and corrects it, in stages.

Where the result would still exceed the bound on |ω|, the least change that mends it follows. Bounds, ramps
and P_0 hold for any weights. First-order steps may refine the answer.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ded_bench.methods.dpc.channels import Channels, Response, n_channels
from ded_bench.methods.dpc.inference import DILATIONS, EMBEDDING, STAGES, WIDTH, CompiledStages
from ded_bench.methods.dpc.refinement import BoundKeeper, Refiner
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Artifact, Settings, Solver, model_artifact
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.trained_policy import TrainedPolicy, as_solver
from ded_bench.methods.training_record import DEFAULT_MODEL
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.surrogates.find import find_model

VERSION = 1


@dataclass(frozen=True)
class Options:
    """Parameters of `ded-dpc`."""

    refine: int = option(0, "first-order steps that refine the answer; 0: the network's alone", lowest=0)


class DispatchPolicy(TrainedPolicy):
    """A trained network."""

    method = "ded-dpc"

    @functools.cached_property
    def response(self) -> Response:
        """What the network looks at."""
        return Response.make(self.scope.case, self.knots)

    @functools.cached_property
    def _compiled(self) -> CompiledStages:
        return CompiledStages(self.scope.case, self.response, self.weights)

    @functools.cached_property
    def _keeper(self) -> BoundKeeper:
        return BoundKeeper(self.scope.case, self.scope.regime, self.knots)

    def answers(self, instances: Sequence[Instance]) -> Array:
        """See `TrainedPolicy.answers`."""
        return self.powers(StackedInstances.of(self.scope.case, instances))

    def powers(self, inputs: StackedInstances) -> Array:
        """Generator powers at the knots, shape (batch, n_knots, n_gen), pu, from stacked arrays."""
        return self._keeper(inputs, self._compiled(Channels.of(self.scope.case, inputs, self.response)))

    @staticmethod
    def shapes(case: Case, training: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """See `TrainedPolicy.shapes`; in the order of a StagedNetwork's state dict."""
        n_gen, (n_sequence, n_constants), n_blocks = len(case.generators), n_channels(case), len(DILATIONS)
        n_seen = n_gen + 2 * (n_gen + 1) + n_sequence
        stage: dict[str, tuple[int, ...]] = {
            "sequence_mean": (n_seen,),
            "sequence_scale": (n_seen,),
            "constants_mean": (n_constants,),
            "constants_scale": (n_constants,),
        }
        layers: dict[str, tuple[int, ...]] = {
            "first": (WIDTH, n_seen, 1, 3),
            "embed.0": (EMBEDDING, n_constants),
            "embed.2": (WIDTH * (1 + n_blocks), EMBEDDING),
            **{f"spread.{i}": (WIDTH, WIDTH, 1, 3) for i in range(n_blocks)},
            **{f"mix.{i}": (WIDTH, WIDTH, 1, 1) for i in range(n_blocks)},
            "last": (n_gen, WIDTH, 1, 1),
        }
        for name, shape in layers.items():
            stage |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
        return {f"stages.{i}.{name}": shape for i in range(STAGES) for name, shape in stage.items()}


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use, and the model of the steps that refine its answers."""
    found = DispatchPolicy.artifacts(case, regime, settings)
    refined = read_options(Options, settings.options).refine > 0
    return (*found, model_artifact(case, settings)) if refined else found


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method; condensing and factorising are done once per time grid.

    Raises:
        InputError: there is no policy or model (names the command that makes one), or it does not fit.
    """
    policy = DispatchPolicy.find(case, regime, settings)
    steps = read_options(Options, settings.options).refine
    if not steps:
        return as_solver(policy, lambda instance: policy.answers([instance])[0])
    model = find_model(case, settings.model or DEFAULT_MODEL, settings.search)
    refiners: dict[tuple[float, int], Refiner] = {}

    def answer(instance: Instance) -> Array:
        grid = instance.dt_s, instance.steps
        if grid not in refiners:
            model.check_step(instance)
            refiners[grid] = Refiner(case, model, regime, instance.grid, policy.knots)
        inputs = StackedInstances.of(case, [instance])
        return np.asarray(refiners[grid](inputs, policy.powers(inputs), steps)[0])

    return as_solver(policy, answer, steps)
