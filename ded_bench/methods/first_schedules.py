"""Schedules to linearise along at first: a plan in force, static dispatch, what the grid can carry."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ded_bench.methods import ed
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

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
    return within_ramps(case, instance, ed.dispatch(case, instance, 1.0), points, PACE)


def static_dispatch(case: Case, instance: Instance) -> Schedule:
    """The static dispatch of every second, on an island as turbines are to deliver it.

    Where no powers within reach balance the loads, P_0 throughout.
    """
    try:
        return ed.dispatch(case, instance, 1.0, lead=case.slack is None)
    except SimulationError:
        p_initial = instance.p_initial(case)
        return Schedule(np.array([0.0, instance.horizon_s]), np.stack([p_initial, p_initial]))


def first_schedules(case: Case, instance: Instance, wanted: Array, points: Indices) -> Iterator[Array]:
    """Powers at the knots to try one after another, each of shape (n_knots, n_gen), pu; all start at P_0.

    The wanted ones; every generator with its share of the load; P_0 throughout; and what lies in the middle.

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
    load = instance.p_load(case)[:: round(1.0 / instance.dt_s)].sum(axis=1)
    if case.slack is None:  # P_0 balances the first loads
        change = (load - load[0]) / case.load_nominal.sum()
        target = instance.p_initial(case) + np.outer(change, case.p_nominal)
    else:
        target = np.outer(load / case.load_nominal.sum(), case.p_nominal)
    return ed.follow_set_points(case, instance, target[1:], 1.0).p
