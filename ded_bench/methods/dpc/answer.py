"""A policy as a method: one answer, timed from the instance to the powers at all grid points."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from ded_bench.methods.solution import Solution, Solver, Status
from ded_bench.problem.case import Array
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Interpolation, Schedule


class KnotPolicy(Protocol):
    """Answers on the same knots whatever the instance."""

    @property
    def knots(self) -> Array:
        """Knot times, s."""

    def __call__(self, instances: Instance) -> list[Schedule]:
        """One schedule, on the knots."""


def method(policy: KnotPolicy) -> Solver:
    """Return a policy as a method; `solve_s` covers features, network and all grid points."""
    interpolations: dict[tuple[float, int], Interpolation] = {}

    def solve(instance: Instance) -> Solution:
        first = policy(instance)[0]  # the first call of a process pays for libraries, not for inference
        grid = instance.dt_s, instance.steps
        if grid not in interpolations:
            interpolations[grid] = Interpolation(policy.knots, instance.grid, first.p.shape[1])
        at_grid = interpolations[grid]
        started = time.perf_counter()
        schedule = policy(instance)[0]
        at_grid(schedule.p)
        elapsed = time.perf_counter() - started
        version = f"numpy {np.__version__}"
        return Solution(Status.POLICY, schedule, solve_s=elapsed, solver_version=version)

    return solve
