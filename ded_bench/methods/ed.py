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
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import knot_points, track
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.problem.case import Array, Case, Indices
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

    every: float | None = option(None, "s between dispatches; none: 60, islands: 1", lowest=1e-3, below=1e6)
    lead: bool = option(False, "on islands: turbines deliver the dispatch, governors' lags are led")


def check(case: Case, settings: Settings) -> Options:
    """The options; InputError if the case has no governors to lead."""
    options = read_options(Options, settings.options)
    if options.lead and case.slack is not None:
        raise InputError("--set", "lead", f"needs an island; case {case.id} has a slack")
    return options


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a dispatcher of single instances; both regimes get the same schedules."""
    options = check(case, settings)

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


#: A surrogate's model is taken along the static dispatch, followed at this part of the ramp limits: as fast
#: as they allow, frequency swings tens of times farther than a tight bound lets it, and the linear model's
#: error grows with the square of the distance (two-area, TO, validation draws: 0.48 mHz at 1, 0.06 at 0.3,
#: 0.03 at 0.2 and 0.1, 0.05 at 0.05).
PACE = 0.2


def slow_dispatch(case: Case, instance: Instance, points: Indices) -> Array:
    """The static dispatch of every second, followed slowly: powers at the knots, (n_knots, n_gen), pu.

    On an island, where what is missing moves all frequencies, it is followed as fast as turbines can.
    """
    if case.slack is None:
        return within_ramps(case, instance, static_dispatch(case, instance), points)
    return within_ramps(case, instance, dispatch(case, instance, 1.0), points, PACE)


def static_dispatch(case: Case, instance: Instance, lead: bool = True) -> Schedule:
    """The static dispatch of every second, on an island with `lead` as turbines are to deliver it.

    Where no powers within reach balance the loads, P_0 throughout.
    """
    try:
        return dispatch(case, instance, 1.0, lead and case.slack is None)
    except SimulationError:
        p_initial = instance.p_initial(case)
        return Schedule(np.array([0.0, instance.horizon_s]), np.stack([p_initial, p_initial]))


def first_schedules(case: Case, instance: Instance, wanted: Array, points: Indices) -> Iterator[Array]:
    """Powers at the knots to try one after another, each of shape (n_knots, n_gen), pu; all start at P_0.

    The wanted ones; every generator with its share of the load; P_0 throughout; what lies in the middle; on
    islands the static dispatch that no governor is led for, which all drawn instances can be served by.

    Args:
        case: the grid.
        instance: P_0 and the loads.
        wanted: powers at the knots, shape (n_knots, n_gen), pu.
        points: grid points of the knots, shape (n_knots,).
    """
    yield wanted
    shared = _shared_load(case, instance)[points]
    constant = np.broadcast_to(instance.p_initial(case), wanted.shape)
    yield shared
    yield constant
    yield (wanted + shared) / 2
    yield (constant + shared) / 2
    if case.slack is None:
        yield within_ramps(case, instance, static_dispatch(case, instance, lead=False), points)


def within_ramps(case: Case, instance: Instance, plan: Schedule, points: Indices, pace: float = 1.0) -> Array:
    """A plan from P_0 on, at this part of the ramp limits: powers at the knots, (n_knots, n_gen), pu."""
    p_gen = plan.at(instance.grid[points])
    p_gen[0] = instance.p_initial(case)
    reach = pace * np.outer(np.diff(points) * instance.dt_s, case.ramp)
    for j, most in enumerate(reach):
        p_gen[j + 1] = p_gen[j] + np.clip(p_gen[j + 1] - p_gen[j], -most, most)
    return p_gen


def _shared_load(case: Case, instance: Instance) -> Array:
    """Every second each generator goes towards its share, by nominal powers, of the load.

    Returns:
        Powers at all grid points, shape (n_points, n_gen), pu.
    """
    load = instance.p_load(case).sum(axis=1)
    asked, nominal = load[_intervals(instance, 1.0)[1]], case.load_nominal.sum()
    if case.slack is None:  # P_0 balances the first loads
        target = instance.p_initial(case) + np.outer((asked - load[0]) / nominal, case.p_nominal)
    else:
        target = np.outer(asked / nominal, case.p_nominal)
    return follow_set_points(case, instance, target, 1.0).p
