"""Which drawn instances the power flow can serve: the rule by which every part of the suite draws them."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ded_bench.plants.lossless.network import Network, PowerFlowError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, LoadRamp

#: Numbers in the Jacobians of power flows that are solved together.
BATCH = 1_000_000


def servable(case: Case, instances: Sequence[Instance]) -> NDArray[np.bool_]:
    """Tell which instances the power flow can serve, shape (n,), by the rule of `check_servable`.

    It must serve the initial loads from P_0, and the loads at 0, at each kink and at the horizon from the
    static dispatch. The loads of drawn instances ramp once each.
    """
    network = _network(case)
    powers = [_powers(case, instance) for instance in instances]
    p_gen = np.concatenate([gen for gen, _ in powers])
    p_load = np.concatenate([load for _, load in powers])
    return np.asarray(_served(network, p_gen, p_load).reshape(len(instances), -1).all(axis=1))


def _powers(case: Case, instance: Instance) -> tuple[Array, Array]:
    """Powers that must be servable, shapes (2 n_load + 3, n_gen) and (2 n_load + 3, n_load), pu."""
    ramps = [load for load in instance.load.values() if isinstance(load, LoadRamp)]
    ends = [t for ramp in ramps for t in (ramp.start, ramp.start + ramp.duration)]
    times = np.minimum([0.0, *ends, instance.horizon_s], instance.horizon_s)
    p_load = instance.p_load(case, times)
    p_gen = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), p_load)
    return np.vstack([instance.p_initial(case), p_gen]), np.vstack([p_load[0], p_load])


def _served(network: Network, p_gen: Array, p_load: Array) -> NDArray[np.bool_]:
    """Tell which rows of powers the power flow can serve; a batch that fails is halved until one is left."""
    n = len(p_gen)
    if n == 1 or n * network.n_bus**2 <= BATCH:
        try:
            network.power_flow(p_gen, p_load)
        except PowerFlowError:
            if n == 1:
                return np.zeros(1, dtype=np.bool_)
        else:
            return np.ones(n, dtype=np.bool_)
    halves = (_served(network, p_gen[s], p_load[s]) for s in (slice(n // 2), slice(n // 2, n)))
    return np.concatenate(list(halves))


@functools.lru_cache(maxsize=4)
def _network(case: Case) -> Network:
    return Network(case)
