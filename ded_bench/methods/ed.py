"""Traditional dispatch: static economic dispatch at intervals, followed at the ramp limit.

What operators do without DED. Frequency limits play no role in it.

* Beside an infinite slack every interval the generators get the merit order's set-points for the interval's
  mean forecast load and move to them as fast as they may. The slack takes what is missing.
* On an island base points go from one dispatch to the next, which balances forecast loads and losses at the
  interval's end. With `lead` they are sent through the inverse of the governors, so that turbines deliver
  them, as far as ramps and limits of set-points let them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import knot_points
from ded_bench.methods.options import option, read_options
from ded_bench.methods.ramp_follower import track
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1
#: From one dispatch to the next beside an infinite slack, s.
INTERVAL_S = 60.0
#: Distance of points of what is led, s: governors are slower.
LEAD_S = 0.1


@dataclass(frozen=True)
class Options:
    """How often is dispatched."""

    every: float | None = option(
        None, "s from one dispatch to the next; none: 60, on islands 1 and at kinks of loads", lowest=1e-3
    )
    lead: bool = option(False, "on islands: turbines deliver the dispatch, governors' lags are led")


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a dispatcher of single instances; both regimes get the same schedules."""
    case.check_regimes([regime])
    options = read_options(Options, settings.options)
    if options.lead and case.slack is not None:
        raise InputError("--set", "lead", f"needs an island; case {case.id} has a slack")

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        try:
            schedule = dispatch(case, instance, options.every, options.lead)
        except SimulationError as error:
            return Solution(Status.FAILED, error=str(error), solve_s=time.perf_counter() - started)
        return Solution(Status.FEASIBLE, schedule, solve_s=time.perf_counter() - started)

    return solve


def dispatch(case: Case, instance: Instance, interval_s: float | None = None, lead: bool = False) -> Schedule:
    """Static dispatch (the paper's P_opt), reached from P_0.

    Args:
        case: the grid.
        instance: costs, loads, P_0.
        interval_s: time between dispatches, s; the last interval ends with the horizon. None: see `Options`.
        lead: see `Options`.

    Returns:
        A schedule. It starts at P_0 and moves by at most the ramp limit; it is within the generator bounds
        if P_0 is.

    Raises:
        SimulationError: on an island no powers within reach balance the loads.
    """
    if case.slack is None:
        return _on_island(case, instance, interval_s, lead)
    interval_s = INTERVAL_S if interval_s is None else interval_s
    starts, ends = _intervals(instance, interval_s)
    load = instance.p_load(case)
    # Loads are linear between grid points, so that the trapezoidal rule gives their exact mean.
    mean = [np.trapezoid(load[a : b + 1], axis=0) / (b - a) for a, b in zip(starts, ends, strict=True)]
    prices = instance.cost_gen(case), instance.cost_slack(case)
    return follow_set_points(case, instance, merit_order(case, *prices, np.stack(mean)), interval_s)


def _on_island(case: Case, instance: Instance, interval_s: float | None, lead: bool) -> Schedule:
    """Base points from one dispatch to the next."""
    plant, dt_s = plant_of(case), instance.dt_s
    times = np.append(np.arange(0.0, instance.horizon_s - dt_s / 2, interval_s or 1.0), instance.horizon_s)
    if interval_s is None:
        times = np.concatenate([times, instance.kinks])
    times = instance.grid[knot_points(times, dt_s)]
    base = Schedule(times, plant.static_dispatch(instance, times))
    if not lead:
        return base
    power = plant.set_points_delivering(base.at(instance.grid), dt_s)
    power[0] = instance.p_initial(case)
    track(power[None], case.p_min, case.p_max, case.ramp * dt_s)
    points = np.append(np.arange(0, instance.steps, max(round(LEAD_S / dt_s), 1)), instance.steps)
    return Schedule(instance.grid[points], power[points])


def follow_set_points(case: Case, instance: Instance, targets: Array, interval_s: float) -> Schedule:
    """Move from P_0 to one set-point after another, within bounds, as fast as the ramp limit lets.

    Args:
        targets: set-points of the intervals, shape (n_intervals, n_gen), pu.
        interval_s: time between set-points, s.
    """
    starts, ends = _intervals(instance, interval_s)
    power = np.vstack([instance.p_initial(case), np.repeat(targets, np.subtract(ends, starts), axis=0)])
    track(power[None], case.p_min, case.p_max, case.ramp * instance.dt_s)
    return Schedule(t=instance.grid, p=power)


def _intervals(instance: Instance, interval_s: float) -> tuple[list[int], list[int]]:
    """Grid indices at which intervals start and end; none is shorter than a step of the grid."""
    starts = list(range(0, instance.steps, max(round(interval_s / instance.dt_s), 1)))
    return starts, [*starts[1:], instance.steps]
