"""Schedules to linearise along at first, where the network cannot carry the one that is wanted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ded_bench.methods import ed
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance


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


def _shared_load(case: Case, instance: Instance) -> Array:
    """Every second each generator goes towards its share, by nominal powers, of the load.

    Returns:
        Powers at all grid points, shape (n_points, n_gen), pu.
    """
    load = instance.p_load(case)[:: round(1.0 / instance.dt_s)].sum(axis=1)
    target = np.outer(load / case.load_nominal.sum(), case.p_nominal)
    return ed.follow_set_points(case, instance, np.clip(target, case.p_min, case.p_max)[1:], 1.0).p
