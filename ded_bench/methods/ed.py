"""Traditional dispatch: static economic dispatch at intervals, followed at the ramp limit.

What operators do without DED: every interval the generators get the merit order's set-points for
the interval's mean forecast load and move to them as fast as they may. The swing bus takes what
is missing. Frequency limits play no role in it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.options import option, read_options
from ded_bench.methods.ramp_follower import follow
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1


@dataclass(frozen=True)
class Options:
    """How often is dispatched."""

    every: float = option(60.0, "s from one dispatch to the next", lowest=1e-3)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a dispatcher of single instances; both regimes get the same schedules."""
    case.check_regimes([regime])
    every = read_options(Options, settings.options).every

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        schedule = dispatch(case, instance, every)
        return Solution(Status.FEASIBLE, schedule, solve_s=time.perf_counter() - started)

    return solve


def dispatch(case: Case, instance: Instance, interval_s: float) -> Schedule:
    """Static dispatch (the paper's P_opt) of the mean load of every interval, reached from P_0.

    Args:
        interval_s: time between dispatches, s; the last interval ends with the horizon.

    Returns:
        A schedule on the instance's grid. It starts at P_0 and moves by at most the ramp limit;
        it is within the generator bounds if P_0 is.
    """
    starts, ends = _intervals(instance, interval_s)
    load = instance.p_load(case)
    # Loads are linear between grid points, so that the trapezoidal rule gives their exact mean.
    mean = [np.trapezoid(load[a : b + 1], axis=0) / (b - a) for a, b in zip(starts, ends, strict=True)]
    prices = instance.cost_gen(case), instance.cost_slack(case)
    return follow_set_points(case, instance, merit_order(case, *prices, np.stack(mean)), interval_s)


def follow_set_points(case: Case, instance: Instance, targets: Array, interval_s: float) -> Schedule:
    """Move from P_0 to one set-point after another, as fast as the ramp limit lets.

    Args:
        targets: set-points of the intervals, shape (n_intervals, n_gen), pu.
        interval_s: time between set-points, s.
    """
    starts, ends = _intervals(instance, interval_s)
    at_points = np.repeat(targets, np.subtract(ends, starts), axis=0)
    power = follow(at_points[None], instance.p_initial(case)[None], case.ramp * instance.dt_s)[0]
    return Schedule(t=instance.grid, p=power)


def _intervals(instance: Instance, interval_s: float) -> tuple[list[int], list[int]]:
    """Grid indices at which intervals start and end; none is shorter than a step of the grid."""
    starts = list(range(0, instance.steps, max(round(interval_s / instance.dt_s), 1)))
    return starts, [*starts[1:], instance.steps]
