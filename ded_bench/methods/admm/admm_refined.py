"""DED-DPC, refined (`ded-dpc-shared-refined`): more iterations, along the path of the policy's answer."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ded_bench.methods.admm import admm_policy as shared_policy
from ded_bench.methods.admm.admm_inference import CompiledIterations
from ded_bench.methods.admm.admm_policy import SharedPolicy
from ded_bench.methods.admm.path_model import PathModel
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.policy_solver import VERSION, warmed_up
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

METHOD = "ded-dpc-shared-refined"
#: Whether weights are those of the policy; else they are those where training starts.
SETTINGS: Mapping[str, Mapping[str, Any]] = {"default": {"learned": True}, "unlearned": {"learned": False}}
#: Iterations after those of the policy, and by what part of it they keep away from the bound on |ω|: their
#: schedules ride it, and the linearised grid errs (docs/model.md).
ITERATIONS, MARGIN = 80, 0.01
#: Weights that were learned for fewer iterations take long steps and do not serve so many: the policy answers
#: with them, and goes on with those where training starts.
LEARNED_FOR = 10


@dataclass(frozen=True, eq=False)
class Refiner:
    """Improves a policy's answers."""

    policy: SharedPolicy
    model: PathModel  # its bound is tighter by `MARGIN`, not by the policy's margin
    more: CompiledIterations

    @staticmethod
    def of(policy: SharedPolicy, learned: bool) -> Refiner:
        """The refiner of a policy, or of one with the weights where training starts."""
        start = {name: np.zeros_like(values) for name, values in policy.weights.items()}
        if not learned:
            policy = dataclasses.replace(policy, weights=start)
        weights = policy.weights if policy.training["iterations"] >= LEARNED_FOR else start
        case, regime = policy.scope.case, policy.scope.regime
        model = PathModel(case, (1.0 - MARGIN) * case.omega_bound(regime), policy.model.response)
        return Refiner(policy, model, CompiledIterations(model, weights, ITERATIONS))

    def __call__(self, instance: Instance) -> Schedule:
        """A schedule on the policy's knots.

        Raises:
            InputError: the instance belongs to another case or horizon, or its loads cannot be served.
        """
        policy = self.policy
        outset = policy.model.outset(policy.problems([instance]))
        linear = policy.model.linearise(outset, policy.model.start_path(outset))
        answer = policy.answer(outset, linear)
        along = self.model.along(outset, self.model.respond(answer, outset, linear)[0])
        return Schedule(policy.knots, self.more(outset, along, answer)[0])


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    return shared_policy.artifacts(case, regime, _plain(settings))


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the refined policy as a method."""
    policy = shared_policy.find_policy(case, regime, _plain(settings))
    refiner = Refiner.of(policy, SETTINGS[settings.name]["learned"])

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        schedule = refiner(instance)
        elapsed = time.perf_counter() - started
        return Solution(Status.POLICY, schedule, ITERATIONS, solve_s=elapsed, solver_version=VERSION)

    return warmed_up(solve, policy.scope)


def _plain(settings: Settings) -> Settings:
    """Of the policy: it is the one of the default training, whatever refines it."""
    return dataclasses.replace(settings, name="default")
