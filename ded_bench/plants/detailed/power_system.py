"""Network and machines of one case together: power flow, equilibrium, linearisation and its modes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.plants.detailed.machine_arrays import (
    DELTA,
    E1D,
    E1Q,
    E2D,
    E2Q,
    EXCITER,
    FEEDBACK,
    FIELD,
    GATE,
    N_STATES,
    TURBINE,
    MachineArrays,
    machine_arrays,
    moving,
)
from ded_bench.plants.detailed.power_flow import Complex, OperatingPoint, PortNetwork, port_network
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Case
from ded_bench.problem.quantities import Array

if TYPE_CHECKING:
    from ded_bench.plants.detailed.detailed_stepper import CarriedVoltages, DetailedStates
    from ded_bench.plants.detailed.equations import CompiledNetwork
    from ded_bench.plants.detailed.symbolic import SymbolicPlant

#: Change of voltages in a fixed-point step at which it ends, pu: a tenth of it, or less, is left.
CHANGE = 1e-10


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


class Slopes(NamedTuple):
    """Derivatives by the states that move, with voltages eliminated."""

    rates: Array  # (n_moving, n_moving), 1/s
    p_e: Array  # electrical powers, (n_machine, n_moving), pu


class Equilibrium(NamedTuple):
    """Where everything rests."""

    x: Array  # states, (N_STATES, n_machine)
    v_ref: Array  # exciters' references, (n_machine,), pu


@dataclass(frozen=True)
class PowerSystem:
    """Equations of a case's grid, by its generators and loads.

    A machine keeps its speed where the slack is infinite, none on an island.
    """

    case: Case

    @functools.cached_property
    def network(self) -> PortNetwork:
        """Admittances between buses with machines or loads."""
        files = self.case.detailed
        return port_network(files.network, files.data, self.case.loads)

    @functools.cached_property
    def data(self) -> MachineArrays:
        """The machines."""
        machines = self.case.detailed.data
        infinite = None if self.island else machines.machines[self.network.balancing].name
        return machine_arrays(machines, self.network.machine_port, infinite)

    @property
    def island(self) -> bool:
        """Whether every machine can change its speed."""
        return self.case.slack is None

    @functools.cached_property
    def scheduled(self) -> Indices:
        """The machine of each generator, (n_gen,)."""
        order = list(self.case.detailed.machines)
        return np.array([order.index(self.case.machine_of(name)) for name in self.case.generators])

    @functools.cached_property
    def load_ports(self) -> Indices:
        """The port of each load, (n_load,)."""
        return np.array([self.network.port_names.index(bus) for bus in self.case.loads])

    @functools.cached_property
    def shares(self) -> Array:
        """What part of secondary control each machine takes, (n_machine,)."""
        given = {} if self.case.agc is None else self.case.agc.participation
        return np.array([given.get(name, 0.0) for name in self.case.detailed.machines])

    def p_machine(self, p_set: Array) -> Array:
        """Powers of all machines, (n_machine,), pu, by those of the generators; the slack's is nominal."""
        powers = self.network.p_nominal.copy()
        powers[self.scheduled] = p_set
        return powers

    def p_drawn(self, p_load: Array) -> Array:
        """Active power drawn at the ports under load injections (..., n_load); others are nominal; pu."""
        drawn = np.empty((*p_load.shape[:-1], len(self.network.ports)))
        drawn[:] = self.network.p_drawn
        drawn[..., self.load_ports] = -p_load
        return drawn

    def turbines(self, x: Array) -> Array:
        """Mechanical powers, (..., n_machine), pu, at states (..., N_STATES, n_machine)."""
        reheat = self.data.reheat
        return np.asarray(reheat * x[..., GATE, :] + (1.0 - reheat) * x[..., TURBINE, :])

    @functools.cached_property
    def moving(self) -> Indices:
        """See `machine_arrays.moving`."""
        return moving(self.data)

    @functools.cached_property
    def symbolic(self) -> SymbolicPlant:
        """The equations with their Jacobians."""
        from ded_bench.plants.detailed.symbolic import symbolic_plant  # CasADi: help does without

        return symbolic_plant(self.data, self.network)

    @functools.cached_property
    def compiled_network(self) -> CompiledNetwork:
        """What compiled functions see of the network."""
        from ded_bench.plants.detailed.equations import CompiledNetwork  # and with it Numba

        y = self.network.admittance.copy()
        np.add.at(y, (self.data.port, self.data.port), 1.0 / (1j * self.data.x))
        real = np.empty((2 * len(y), 2 * len(y)))
        real[0::2, 0::2] = real[1::2, 1::2] = y.real
        real[0::2, 1::2], real[1::2, 0::2] = -y.imag, y.imag
        return CompiledNetwork(real.T.copy(), self.network.q_drawn[: self.network.n_load_port].copy(), CHANGE)

    @functools.cached_property
    def fastest(self) -> float:
        """Size of the fastest mode at the nominal point, 1/s."""
        return float(np.abs(self.modes(self.network.nominal())).max())

    def equilibrium(self, point: OperatingPoint) -> Equilibrium:
        """States at rest; the inertia-weighted mean of rotor angles is zero, so voltages turn with them.

        A classical machine keeps its voltage behind x'd as `e1q`, one without exciter its field voltage.
        """
        data = self.data
        at = point.voltage[data.port]
        current = (point.power / at).conj()
        delta = np.angle(at + 1j * data.xq * current)
        turn = np.exp(1j * (np.pi / 2 - delta))
        v, i = at * turn, current * turn
        v_f = v.imag + data.xd * i.real
        x = np.zeros((N_STATES, len(delta)))
        x[DELTA] = delta
        x[E1Q] = v.imag + data.xd1 * i.real
        x[E1D] = (data.xq - data.xq1) * i.imag
        x[E2D] = x[E1Q] - (data.xd1 - data.xl) * i.real
        x[E2Q] = x[E1D] + (data.xq1 - data.xl) * i.imag
        x[FIELD] = x[FEEDBACK] = v_f
        needed = np.divide(data.ke * v_f, data.gain, out=np.zeros_like(v_f), where=data.gain > 0.0)
        x[EXCITER] = np.where(data.dc > 0.0, data.ke * v_f, needed)
        x[GATE] = x[TURBINE] = point.power.real
        return Equilibrium(x, np.abs(at) + needed)

    def slopes(self, x: Array, voltage: Complex, p_drawn: Array) -> Slopes:
        """Linearise at states (N_STATES, n_machine) and voltages (n_port,), pu."""
        n, n_v = len(self.data.port), 2 * len(voltage)
        references = np.zeros(n)  # they enter linearly
        given = x.ravel(), interleaved(voltage), references, p_drawn, references
        full = self.symbolic.jacobian(*given).sparse().tocsr()
        columns, by_v = full[:, : x.size].tocsc()[:, self.moving].toarray(), full[:, x.size :]
        balance = slice(x.size, x.size + n_v)
        reduced = columns + by_v @ np.linalg.solve(by_v[balance].toarray(), -columns[balance])
        return Slopes(reduced[self.moving], reduced[x.size + n_v :][:n])

    def modes(self, point: OperatingPoint) -> NDArray[np.complex128]:
        """Eigenvalues at an equilibrium, 1/s, ascending in size; that of an island's free angle is first."""
        rest = self.equilibrium(point)
        values = np.linalg.eigvals(self.slopes(rest.x, point.voltage, point.p_drawn).rates)
        return np.asarray(values[np.argsort(np.abs(values))], dtype=np.complex128)

    def stable(self, point: OperatingPoint) -> bool:
        """Tell whether an equilibrium is one to which small deviations return."""
        return bool((self.modes(point)[int(self.island) :].real < 0.0).all())


def interleaved(voltage: Complex) -> Array:
    """Real and imaginary parts in turn, (..., 2 n)."""
    return np.ascontiguousarray(voltage).view(np.float64)
