"""What a case says about the equations: which machines follow schedules, where loads are, who shares AGC."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ded_bench.plants.detailed.machine_arrays import GATE, TURBINE
from ded_bench.plants.detailed.power_system import PowerSystem
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Case
from ded_bench.problem.quantities import Array

if TYPE_CHECKING:
    from ded_bench.plants.detailed.detailed_stepper import CarriedVoltages, DetailedStates


class DetailedState(NamedTuple):
    """Where the plant is, and what it keeps throughout."""

    x: Array  # (N_STATES, n_machine); on an island the mean rotor angle is the integral of the mean frequency
    v: Array  # voltages at ports in the frame of the mean angle, (2 n_port,), pu
    held: float  # what AGC asks of all machines together, pu
    next_s: float  # when it acts next
    v_ref: Array  # exciters' references, (n_machine,), pu
    offset: Array  # governors' references less set-points, (n_machine,), pu
    p_set: Array  # (n_gen,), pu
    carried: CarriedVoltages | None = None  # by the integrator; None: nothing happened before


class DetailedRun(NamedTuple):
    """`Piece.states` of the detailed plant."""

    states: DetailedStates
    agc_points: Indices  # where secondary control acted
    steps: int  # of the integrator from one point to the next


@dataclass(frozen=True)
class CaseSystem:
    """The equations of a case's grid, by its generators and loads."""

    case: Case

    @functools.cached_property
    def system(self) -> PowerSystem:
        """The equations."""
        files = self.case.detailed
        return PowerSystem.of(files.network, files.data, self.case.slack is None, self.case.loads)

    @functools.cached_property
    def scheduled(self) -> Indices:
        """The machine of each generator, (n_gen,)."""
        order = list(self.case.detailed.machines)
        return np.array([order.index(self.case.machine_of(name)) for name in self.case.generators])

    @functools.cached_property
    def load_ports(self) -> Indices:
        """The port of each load, (n_load,)."""
        return np.array([self.system.network.port_names.index(bus) for bus in self.case.loads])

    @functools.cached_property
    def shares(self) -> Array:
        """What part of secondary control each machine takes, (n_machine,)."""
        given = {} if self.case.agc is None else self.case.agc.participation
        return np.array([given.get(name, 0.0) for name in self.case.detailed.machines])

    def p_machine(self, p_set: Array) -> Array:
        """Powers of all machines, (n_machine,), pu, by those of the generators; the slack's is nominal."""
        powers = self.system.network.p_nominal.copy()
        powers[self.scheduled] = p_set
        return powers

    def p_drawn(self, p_load: Array) -> Array:
        """Active power drawn at the ports under load injections (..., n_load); others are nominal; pu."""
        drawn = np.empty((*p_load.shape[:-1], len(self.system.network.ports)))
        drawn[:] = self.system.network.p_drawn
        drawn[..., self.load_ports] = -p_load
        return drawn

    def turbines(self, x: Array) -> Array:
        """Mechanical powers, (..., n_machine), pu, at states (..., N_STATES, n_machine)."""
        reheat = self.system.data.reheat
        return np.asarray(reheat * x[..., GATE, :] + (1.0 - reheat) * x[..., TURBINE, :])
