"""Instances of one case as stacked arrays: what learned policies read."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance, LoadPoints, LoadRamp

#: A segment that no load reaches: it starts later than any horizon ends, s.
NEVER = [1e30, 0.0, 0.0]


@dataclass(frozen=True, eq=False)
class StackedInstances:
    """Instances in the units of the files.

    Angles at t = 0 that are those of an equilibrium follow from P_0 and the initial loads, so that no power
    flow has to be solved; where an instance gives others, their deviation counts.
    """

    load: Array  # segments, see `load_segments`, (batch, n_load, n_segments, 3); or as their user has them
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu
    delta: Array  # θ(0) less the equilibrium of P_0 and the initial loads, (batch, n_gen), rad
    omega: Array  # ω(0), (batch, n_gen), rad/s

    @staticmethod
    def of(case: Case, instances: Sequence[Instance]) -> StackedInstances:
        """Stack instances.

        Raises:
            SimulationError: an instance gives angles at t = 0, but there is no equilibrium to compare with.
        """
        return StackedInstances(
            load=load_segments(case, instances),
            cost=np.array([[i.cost[bus] for bus in case.priced] for i in instances]),
            p_initial=np.array([i.p_initial(case) for i in instances]),
            delta=np.array([_deviation(case, i) for i in instances]),
            omega=np.array([i.omega_initial(case) for i in instances]),
        )

    def __len__(self) -> int:
        return len(self.load)

    def __getitem__(self, rows: slice) -> StackedInstances:
        return StackedInstances(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def p_load(self, times: Array) -> Array:
        """Load injections, shape (batch, n_times, n_load), pu."""
        start, value, slope = (self.load[:, None, :, :, i] for i in range(3))
        found = np.broadcast_to(value[..., 0], (len(self), len(times), self.load.shape[1]))
        for k in range(self.load.shape[2]):
            since = times[:, None] - start[..., k]
            found = np.where(since < 0.0, found, value[..., k] + slope[..., k] * since)
        return found


def load_segments(case: Case, instances: Sequence[Instance]) -> Array:
    """Linear pieces of the loads: (start in s, injection there in pu, slope in pu/s) of one after another.

    Returns:
        Shape (batch, n_load, n_segments, 3); rows of fewer segments are filled with `NEVER`.
    """
    paths = [_segments(i.load[bus]) for i in instances for bus in case.loads]
    longest = max(map(len, paths), default=0)
    flat = [number for path in paths for number in path + NEVER * ((longest - len(path)) // 3)]
    return np.array(flat).reshape(len(instances), len(case.loads), longest // 3, 3)


def _segments(load: LoadRamp | LoadPoints) -> list[float]:
    if isinstance(load, LoadRamp):
        initial, start, duration, rate = load.initial, load.start, load.duration, load.rate
        return [0.0, initial, 0.0, start, initial, rate, start + duration, initial + rate * duration, 0.0]
    path: list[float] = []
    for (t, p), (t_next, p_next) in itertools.pairwise(load.points.tolist()):
        path += [t, p, (p_next - p) / (t_next - t)]
    return path


def _deviation(case: Case, instance: Instance) -> Array:
    """δθ, (n_gen,), rad; a power flow is solved only if the instance gives angles."""
    theta = instance.theta_initial(case)
    if theta is None:
        return np.zeros(len(case.generators))
    network = Network(case)
    p_load = instance.p_load(case, np.zeros(1))[0]
    return np.asarray(theta - network.power_flow(instance.p_initial(case), p_load)[network.generators])
