"""A policy as a method: one answer, timed from the instance to the powers at the knots."""

from __future__ import annotations

import time
from typing import Protocol

import numba
import numpy as np

from ded_bench.methods.policy_file import Scope
from ded_bench.methods.solution import Solution, Solver
from ded_bench.plants.plant import servable
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

VERSION = f"numba {numba.__version__}, numpy {np.__version__}"


class KnotPolicy(Protocol):
    """Answers on the same knots whatever the instance."""

    @property
    def scope(self) -> Scope:
        """What the policy was trained for."""

    def __call__(self, instances: Instance) -> list[Schedule]:
        """One schedule, on the knots."""


def method(policy: KnotPolicy) -> Solver:
    """Return a policy as a method; `solve_s` covers features, network and powers at the knots."""

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        schedule = policy(instance)[0]
        elapsed = time.perf_counter() - started
        return Solution(Status.POLICY, schedule, solve_s=elapsed, solver_version=VERSION)

    return warmed_up(solve, policy.scope)


def warmed_up(solve: Solver, scope: Scope) -> Solver:
    """Return `solve` after one call: what the first costs (compilation, libraries) is paid here.

    The instance is drawn from a seed of policy training, so that no answer is computed twice.
    """
    case = scope.case
    instance = sample_instance(case, POLICY_SEED, 0, servable)
    solve(instance.model_copy(update={"horizon_s": scope.horizon_s}))
    return solve
