"""DED-DPC, refined (`ded-dpc-refined`): the policy's answer after a fixed number of first-order steps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc import policy as dpc_policy
from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.methods.dpc.refinement import STEPS, Refiner
from ded_bench.methods.model_artifact import model_artifact
from ded_bench.methods.policy_solver import VERSION, warmed_up
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import find_model

METHOD = "ded-dpc-refined"
#: Number of steps, by slug.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "default": {"steps": STEPS},
    "steps25": {"steps": 25},
    "steps100": {"steps": 100},
    "steps1000": {"steps": 1000},
}


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy and the model that `prepare` would use."""
    return (*dpc_policy.artifacts(case, regime, _plain(settings)), model_artifact(case, settings))


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the refined policy as a method; condensing and factorising are done once per time grid."""
    policy = dpc_policy.find_policy(case, regime, _plain(settings))
    model = find_model(case, settings.model, settings.search)
    steps: int = SETTINGS[settings.name]["steps"]
    refiners: dict[tuple[float, int], Refiner] = {}

    def solve(instance: Instance) -> Solution:
        policy.scope.check([instance])
        grid = instance.dt_s, instance.steps
        if grid not in refiners:
            refiners[grid] = Refiner.make(case, model, regime, instance.grid, policy.knots)
        refiner = refiners[grid]
        started = time.perf_counter()
        inputs = Inputs.of(case, [instance])
        schedule = Schedule(policy.knots, refiner(inputs, policy.powers(inputs), steps)[0])
        elapsed = time.perf_counter() - started
        return Solution(Status.POLICY, schedule, steps, solve_s=elapsed, solver_version=VERSION)

    return warmed_up(solve, policy.scope)


def _plain(settings: Settings) -> Settings:
    """Of the policy: it is the one of the default training, however many steps refine it."""
    return dataclasses.replace(settings, name="default")
