"""A policy as a method: one answer, timed from the instance to the powers at all grid points."""

from __future__ import annotations

import time
from typing import Protocol

import numba
import numpy as np

from ded_bench.methods.dpc.kernels import Indices, compiled
from ded_bench.methods.solution import Solution, Solver
from ded_bench.problem.case import Array
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status


class KnotPolicy(Protocol):
    """Answers on the same knots whatever the instance."""

    @property
    def knots(self) -> Array:
        """Knot times, s."""

    def __call__(self, instances: Instance) -> list[Schedule]:
        """One schedule, on the knots."""


class Interpolation:
    """`Schedule.at` for many schedules on the same knots at the same times: what they share is kept.

    Args:
        t: knot times, strictly increasing, s.
        times: in increasing order, within the knots, s.
    """

    def __init__(self, t: Array, times: Array) -> None:
        interval = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        self._ends = np.cumsum(np.bincount(interval, minlength=len(t) - 1), dtype=np.int64)
        self._width, self._since = np.diff(t), times - t[interval]

    def __call__(self, p: Array) -> Array:
        """Powers at the times, shape (n_times, n_gen), from powers at the knots, (n_knots, n_gen)."""
        found = np.empty((len(self._since), p.shape[1]))
        _interpolate(p, self._ends, self._width, self._since, found)
        return found


@compiled
def _interpolate(p: Array, ends: Indices, width: Array, since: Array, found: Array) -> None:
    """Fill in the points of one interval after another; those of interval j end before `ends[j]`."""
    for g in range(p.shape[1]):
        first = 0
        for j in range(len(ends)):
            slope = (p[j + 1, g] - p[j, g]) / width[j]
            for k in range(first, ends[j]):
                found[k, g] = p[j, g] + slope * since[k]
            first = ends[j]


def method(policy: KnotPolicy) -> Solver:
    """Return a policy as a method; `solve_s` covers features, network and all grid points."""
    interpolations: dict[tuple[float, int], Interpolation] = {}

    def solve(instance: Instance) -> Solution:
        first = policy(instance)[0]  # the first call of a process pays for libraries, not for inference
        grid = instance.dt_s, instance.steps
        if grid not in interpolations:
            interpolations[grid] = Interpolation(policy.knots, instance.grid)
            interpolations[grid](first.p)
        at_grid = interpolations[grid]
        started = time.perf_counter()
        schedule = policy(instance)[0]
        at_grid(schedule.p)
        elapsed = time.perf_counter() - started
        version = f"numba {numba.__version__}, numpy {np.__version__}"
        return Solution(Status.POLICY, schedule, solve_s=elapsed, solver_version=version)

    return solve
