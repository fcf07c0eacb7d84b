"""Network and machines of one case together: power flow, equilibrium, linearisation and its modes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.power_flow import Complex, OperatingPoint, PortNetwork, port_network
from ded_bench.plants.hold import Hold, across_intervals, doubled, repeated
from ded_bench.plants.time_varying import Delivered, Reset, TimeVarying
from ded_bench.problem.case import Case
from ded_bench.problem.quantities import Array, Indices
from ded_bench.problem.schedule import Trajectory

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
    def data(self) -> at.MachineArrays:
        """The machines."""
        machines = self.case.detailed.data
        infinite = None if self.island else machines.machines[self.network.balancing].name
        return at.machine_arrays(machines, self.network.machine_port, infinite)

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
        ports = [self.network.buses[i] for i in self.network.ports]
        return np.array([ports.index(bus) for bus in self.case.loads])

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
        return np.asarray(reheat * x[..., at.GATE, :] + (1.0 - reheat) * x[..., at.TURBINE, :])

    @functools.cached_property
    def moving(self) -> Indices:
        """Places in a flat state array (N_STATES × n) of the states that can change, in ascending order."""
        data = self.data
        rates = np.ones((at.N_STATES, len(data)))
        for state, rate in (
            *((at.E1Q, data.rate_d1), (at.E1D, data.rate_q1), (at.E2D, data.rate_d2), (at.E2Q, data.rate_q2)),
            *((at.EXCITER, data.rate_x), (at.FIELD, data.rate_f), (at.FEEDBACK, data.rate_fb)),
            *((at.WASHOUT, data.rate_w), (at.LEAD_A, data.rate_a), (at.LEAD_B, data.rate_b)),
        ):
            rates[state] = rate
        rates[at.DELTA] = rates[at.SPEED] = data.inverse_m
        return np.flatnonzero(rates)

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
        voltage = point.voltage[data.port]
        current = (point.power / voltage).conj()
        delta = np.angle(voltage + 1j * data.xq * current)
        turn = np.exp(1j * (np.pi / 2 - delta))
        v, i = voltage * turn, current * turn
        v_f = v.imag + data.xd * i.real
        x = np.zeros((at.N_STATES, len(delta)))
        x[at.DELTA] = delta
        x[at.E1Q] = v.imag + data.xd1 * i.real
        x[at.E1D] = (data.xq - data.xq1) * i.imag
        x[at.E2D] = x[at.E1Q] - (data.xd1 - data.xl) * i.real
        x[at.E2Q] = x[at.E1D] + (data.xq1 - data.xl) * i.imag
        x[at.FIELD] = x[at.FEEDBACK] = v_f
        needed = np.divide(data.ke * v_f, data.gain, out=np.zeros_like(v_f), where=data.gain > 0.0)
        x[at.EXCITER] = np.where(data.dc > 0.0, data.ke * v_f, needed)
        x[at.GATE] = x[at.TURBINE] = point.power.real
        return Equilibrium(x, np.abs(voltage) + needed)

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


def linearised(system: PowerSystem, trajectory: Trajectory, points: Indices) -> TimeVarying:
    """Linearise along a trajectory (see `Plant.linearise_along`).

    Raises:
        InputError: secondary control acts between knots.
    """
    run: DetailedRun = trajectory.states
    n_gen = len(system.case.generators)
    if len(np.setdiff1d(run.agc_points, points)):
        problem = "times of secondary control must be among the knots"
        raise InputError(f"case {system.case.id}", "knots", problem)
    kinds, machines = _states(system)
    order = np.searchsorted(system.moving, kinds * len(system.data) + machines)
    n = len(order) + (system.case.agc is not None)
    scale = np.where(kinds == at.SPEED, system.data.omega_0[machines], 1.0)
    middle = (points[:-1] + points[1:]) // 2
    drawn = system.p_drawn(trajectory.p_load[middle])
    rates, slack = np.zeros((len(middle), n, n)), np.zeros((len(middle), n))
    for j, k in enumerate(middle):
        x = run.states.x[k].copy()
        x[at.DELTA] -= system.data.inertia @ x[at.DELTA]
        slopes = system.slopes(x, run.states.v[k].view(np.complex128), drawn[j])
        rates[j, : len(order), : len(order)] = slopes.rates[np.ix_(order, order)] * (scale[:, None] / scale)
        if not system.island:
            slack[j, : len(order)] = slopes.p_e[system.network.balancing, order] / scale
    into = np.zeros((n, n_gen))
    gates = np.flatnonzero(kinds == at.GATE)
    for place in gates[:n_gen]:
        into[place, machines[place] == system.scheduled] = system.data.rate_g[machines[place]]
    reset = None
    if (agc := system.case.agc) is not None:
        rates[:, gates, -1] = (system.data.rate_g * system.shares)[machines[gates]]
        f = np.eye(n)
        f[-1] = 0.0
        f[-1, :-1] = np.where(kinds == at.DELTA, -agc.k * system.data.inertia[machines], 0.0)
        reset = Reset(np.flatnonzero(np.isin(points[:-1], run.agc_points)), f)
    step = _one_step(rates, into, float(trajectory.t[1] - trajectory.t[0]), run.steps)
    powers = doubled(step, np.diff(points))
    across = across_intervals(powers, np.diff(points))
    if reset is not None:
        across.f[reset.intervals] = across.f[reset.intervals] @ reset.f
    c, reheat = np.zeros((n_gen, n)), system.data.reheat  # turbines' powers by gates and turbines
    for kind, weight in ((at.GATE, reheat), (at.TURBINE, 1.0 - reheat)):
        places = np.flatnonzero(kinds == kind)[:n_gen]
        c[np.arange(n_gen), places] = weight[machines[places]]
    delivered = np.broadcast_to(c, (len(middle), *c.shape)), np.zeros((len(middle), n_gen, n_gen))
    return TimeVarying(
        points=points,
        step=step,
        across=across,
        speed=slice(*(np.flatnonzero(kinds == at.SPEED)[[0, -1]] + [0, 1]).tolist()),
        slack=slack,
        omega=trajectory.omega,
        p_slack=trajectory.p_slack,
        p_gen=trajectory.p_set[points],
        delivered=Delivered(*delivered, trajectory.p_gen),
        reset=reset,
        powers=powers,
    )


def _states(system: PowerSystem) -> tuple[Indices, Indices]:
    """Kind and machine of every state that moves; those of the generators first, in their order."""
    n_machine = len(system.data)
    others = np.setdiff1d(np.arange(n_machine), system.scheduled)
    machines = np.tile([*system.scheduled, *others], at.N_STATES)
    kinds = np.repeat(np.arange(at.N_STATES), n_machine)
    moves = np.isin(kinds * n_machine + machines, system.moving)
    return kinds[moves], machines[moves]


def _one_step(rates: Array, into: Array, dt_s: float, steps: int) -> Hold:
    """The map of Kutta's method over one grid step, for inputs linear over it.

    Args:
        rates: A, (n_maps, n_state, n_state), 1/s.
        into: B, (n_state, n_gen).
        dt_s: grid step, s.
        steps: of the integrator in it.
    """
    size = dt_s / steps
    z = rates * size
    square = z @ z
    eye = np.eye(z.shape[1])
    f = eye + z + square @ (eye / 2.0 + z / 6.0 + square / 24.0)
    once = np.broadcast_to(size * into, (len(z), *into.shape))
    twice, thrice = z @ once, square @ once
    g = once + twice / 2.0 + thrice / 6.0 + z @ thrice / 24.0
    h = once / 2.0 + twice / 6.0 + thrice / 24.0
    whole = repeated(Hold(f, g, h), steps)
    return Hold(whole.f, whole.g, whole.h / steps)
