"""`ded-slp` on the full AC network, its setting `ac`: the optimum of the AC problem."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ded_bench.koopman.ac_trajectory import linearise_along_ac
from ded_bench.koopman.trajectory import Indices, TrajectoryModel
from ded_bench.methods.ded_slp import SlpSolver
from ded_bench.methods.solution import Settings
from ded_bench.methods.trust_region import TrustRegionSequence
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.ac_simulate import simulate_ac
from ded_bench.truth.simulate import Trajectory

#: This setting has no options.
SETTINGS: Mapping[str, Mapping[str, Any]] = {"ac": {}}


def prepare(case: Case, regime: str, settings: Settings) -> SlpSolver:
    """Return a solver of single instances, which may start from an earlier solution.

    Raises:
        InputError: the case has no AC data.
    """
    case.check_regimes([regime])
    sequence = functools.partial(TrustRegionSequence, dynamics=AcDynamics(case, AcCase.of(case)))
    return SlpSolver(case, regime, settings.time_limit_s, sequence=sequence, **SETTINGS[settings.name])


@dataclass(frozen=True)
class AcDynamics:
    """The swing equations on the full AC network of a case (see `trust_region.Dynamics`)."""

    case: Case
    data: AcCase

    def simulate(self, instance: Instance, schedule: Schedule) -> Trajectory:
        """See `truth.ac_simulate.simulate_ac`."""
        return simulate_ac(self.case, self.data, instance, schedule)

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TrajectoryModel:
        """See `koopman.ac_trajectory.linearise_along_ac`."""
        return linearise_along_ac(_network(self.case, self.data), trajectory, points)


@functools.lru_cache(maxsize=4)
def _network(case: Case, data: AcCase) -> AcNetwork:
    return AcNetwork(case, data)
