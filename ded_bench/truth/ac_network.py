"""Classical machines on the full AC network of one case: power flow, states, linearisation.

Each machine is a voltage E' of fixed magnitude behind x'd. Angles are relative to the E' of the slack's
machine, which is held. Loads have constant power: the active parts are an instance's where it names them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.ac_case import AcCase, Complex
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.state import State
from ded_bench.truth.network import PowerFlowError

if TYPE_CHECKING:
    from ded_bench.truth.ac_integrator import AcGrid

#: The power flow of P_0 stops where every generator delivers it within this, pu, or after so many steps.
POWER_MISMATCH, NEWTON_STEPS = 1e-11, 30
#: It has failed where it changes an angle (rad) or a voltage (pu) by more at once.
LONGEST = 1.0
#: An equilibrium is unstable where a mode grows by more, 1/s; rounding gives undamped ones less.
GROWTH = 1e-6
#: Shortest step from the nominal powers to those that are wanted, as a part of the way.
SHORTEST = 1 / 128


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """The network at given angles of the generators' E' and given loads."""

    theta: Array  # (n_gen,), rad
    active: Array  # (n_load,), pu: injected by the loads of constant power
    voltage: Array  # (2 n_load,), pu: of these loads, real parts, then imaginary parts
    current: Array  # (2 n_load,), pu: injected by them
    power: Array  # (n_machine,), pu: electrical powers of the machines, the slack's last


@dataclass(frozen=True, eq=False)
class AcLinearisation:
    """Changes of the machines' electrical powers, the slack's last, at an operating point."""

    stiffness: Array  # (n_machine, n_gen), pu/rad
    share: Array  # (n_machine, n_load), pu/pu: by the active powers injected by the loads of constant power


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Derivatives of v - Z i(v) - W e (v_by_...) and of the machines' powers (p_by_...)."""

    v_by_v: Array
    v_by_angle: Array
    v_by_active: Array
    p_by_v: Array
    p_by_angle: Array
    p_by_active: Array


class AcNetwork:
    """The AC network of a case, reduced to machines and loads of constant power.

    Raises:
        InputError: case and AC data do not fit together.
    """

    def __init__(self, case: Case, data: AcCase) -> None:
        machines = data.machines_of(case)
        bus = np.array([data.index[machine.bus] for machine in machines])
        x = np.array([data.reactance(machine) for machine in machines])
        share = np.array([machine.share for machine in machines])
        generated = np.array([complex(b.pg, b.qg) for b in data.buses])
        emf = data.voltage[bus] + 1j * x * np.conj(share * generated[bus] / data.voltage[bus])
        reference = np.angle(emf[-1])
        self.case, self.data = case, data
        self.n_gen, self.n_machine = len(machines) - 1, len(machines)
        self.m = np.array([case.machines[g].m for g in case.generators])
        self.d = np.array([case.machines[g].d for g in case.generators])
        self.theta_nominal = np.asarray(np.angle(emf * np.exp(-1j * reference))[:-1])
        self.emf = np.abs(emf)
        named = [data.index[load] for load in case.loads]
        self.loads = np.array(sorted({*np.flatnonzero(data.loads).tolist(), *named}))
        self._named = np.searchsorted(self.loads, named)
        self._active = data.loads.real[self.loads]
        self.reactive = data.loads.imag[self.loads]
        self._magnitude = np.abs(data.voltage[self.loads])
        own = 1 / (1j * x)
        full = data.admittance.copy()
        np.add.at(full, (bus, bus), own)
        impedance = np.linalg.inv(full)
        #: Voltages of all buses by currents of loads, (n_bus, n_load), and by e, (n_bus, n_machine).
        self._by_load, self._by_emf = impedance[:, self.loads], impedance[:, bus] * own
        self._own_current = np.diag(own) - own[:, None] * self._by_emf[bus]
        self._load_current = -own[:, None] * self._by_load[bus]

    @functools.cached_property
    def grid(self) -> AcGrid:
        """What compiled functions see of this network."""
        from ded_bench.truth.ac_integrator import AcGrid  # and with it Numba: help does without

        return AcGrid(
            emf=self.emf,
            reactive=self.reactive,
            impedance=_real(self._by_load[self.loads]).T.copy(),
            transfer=_real(self._by_emf[self.loads]).T.copy(),
            own_current=_real(self._own_current).T.copy(),
            load_current=_real(self._load_current).T.copy(),
            m=self.m,
            d=self.d,
        )

    def active(self, p_load: Array) -> Array:
        """Active powers injected by all loads of constant power, where the case's inject `p_load`, pu.

        Args:
            p_load: shape (..., n) for the case's n loads.

        Returns:
            Shape (..., n_load): loads that the case does not name are nominal.
        """
        active = np.broadcast_to(self._active, (*p_load.shape[:-1], len(self._active))).copy()
        active[..., self._named] = p_load
        return active

    def operating_point(self, theta: Array, active: Array, guess: Array | None = None) -> OperatingPoint:
        """Voltages and powers at given angles and loads.

        Args:
            theta: angles of the generators' E', shape (n_gen,), rad.
            active: powers of the loads, shape (n_load,), pu; see `active`.
            guess: their voltages, shape (2 n_load,), pu, where Newton's method starts.

        Raises:
            PowerFlowError: the loads cannot be served at these angles.
        """
        from ded_bench.truth.ac_integrator import solve_network  # here only, as in `grid`

        voltage = self._guess(theta, active) if guess is None else guess.copy()
        current, power = np.empty(len(voltage)), np.empty(self.n_machine)
        try:
            solved = solve_network(self.grid, theta, active, voltage, current, power)
        except np.linalg.LinAlgError:
            solved = False
        if not solved:
            raise PowerFlowError("the AC network cannot serve the loads at these angles")
        return OperatingPoint(theta, active, voltage, current, power)

    def power_flow(self, p_gen: Array, p_load: Array) -> OperatingPoint:
        """Where each generator delivers its power, on the branch that leads there from the nominal point.

        Args:
            p_gen: shape (n_gen,), pu.
            p_load: of the case's loads, pu.

        Raises:
            PowerFlowError: the branch ends before, or is not stable there: a voltage or a machine collapses.
        """
        active, nominal = self.active(p_load), self.active(self.case.load_nominal)
        theta, voltage = self.theta_nominal, self._guess(self.theta_nominal, nominal)
        reached, step = 0.0, 1.0
        while True:
            goal = min(reached + step, 1.0)
            wanted = (1 - goal) * self.case.p_nominal + goal * p_gen
            point = self._equilibrium(theta, voltage, wanted, (1 - goal) * nominal + goal * active)
            if point is None:
                step /= 2
                if step < SHORTEST:
                    raise PowerFlowError("the AC power flow has no solution")
                continue
            if goal == 1.0:
                return point
            reached, theta, voltage = goal, point.theta, point.voltage

    def _equilibrium(
        self, theta: Array, voltage: Array, p_gen: Array, active: Array
    ) -> OperatingPoint | None:
        """Newton's method on angles and voltages at once, from given ones; None: no stable equilibrium."""
        n, by_load = len(active), self._by_load[self.loads]
        for _ in range(NEWTON_STEPS):
            v, e = voltage[:n] + 1j * voltage[n:], self._emf_at(theta)
            current = np.conj((active + 1j * self.reactive) / v)
            off = v - by_load @ current - self._by_emf[self.loads] @ e
            delivered = (e * np.conj(self._own_current @ e + self._load_current @ current)).real[:-1]
            wrong = np.concatenate([off.real, off.imag, delivered - p_gen])
            slopes = self._slopes(theta, voltage, active)
            whole = np.block(
                [[slopes.v_by_v, slopes.v_by_angle], [slopes.p_by_v[:-1], slopes.p_by_angle[:-1]]]
            )
            try:
                if np.abs(wrong).max() < POWER_MISMATCH:
                    point = self.operating_point(theta, active, voltage)
                    return point if self.modes(point).real.max() < GROWTH else None
                step = np.linalg.solve(whole, wrong)
            except (np.linalg.LinAlgError, PowerFlowError):
                return None
            if not np.abs(step).max() < LONGEST:
                return None
            voltage, theta = voltage - step[: 2 * n], theta - step[2 * n :]
        return None

    def initial_state(self, instance: Instance) -> State:
        """The generators at t = 0: angles of E' as given, or so that each delivers P_0.

        Raises:
            PowerFlowError: there are no such angles.
        """
        theta = instance.theta_initial(self.case)
        p_gen = instance.p_initial(self.case)
        if theta is None:
            theta = self.power_flow(p_gen, instance.p_load(self.case, np.zeros(1))[0]).theta
        return State(theta, instance.omega_initial(self.case), p_gen)

    def linearise(self, point: OperatingPoint) -> AcLinearisation:
        """Derivatives of the machines' powers by the generators' angles and the loads' active powers."""
        slopes = self._slopes(point.theta, point.voltage, point.active)
        to_power = -np.linalg.solve(slopes.v_by_v.T, slopes.p_by_v.T).T
        stiffness = slopes.p_by_angle + to_power @ slopes.v_by_angle
        return AcLinearisation(stiffness, slopes.p_by_active + to_power @ slopes.v_by_active)

    def modes(self, point: OperatingPoint) -> NDArray[np.complex128]:
        """Eigenvalues in rad/s of the dynamics in (θ, ω), linearised, shape (2 n_gen,), complex."""
        n = self.n_gen
        top = np.hstack([np.zeros((n, n)), np.eye(n)])
        stiffness = self.linearise(point).stiffness[:-1]
        bottom = np.hstack([-stiffness / self.m[:, None], -np.diag(self.d / self.m)])
        return np.linalg.eigvals(np.vstack([top, bottom])).astype(np.complex128)

    def voltages(self, theta: Array, voltage: Array, active: Array) -> Complex:
        """Voltages of all network buses in the order of the AC data, shape (..., n_bus), pu.

        Args:
            theta: angles of the generators' E', shape (..., n_gen), rad.
            voltage: of the loads of constant power, shape (..., 2 n_load), pu.
            active: their active powers, shape (..., n_load), pu.
        """
        n = active.shape[-1]
        v = voltage[..., :n] + 1j * voltage[..., n:]
        current = np.conj((active + 1j * self.reactive) / v)
        return np.asarray(self._emf_at(theta) @ self._by_emf.T + current @ self._by_load.T)

    def bus_angles(self, theta: Array, voltages: Complex) -> Array:
        """Angles of the case's buses over time, shape (n, n_bus), rad: of E' and of network voltages.

        Args:
            theta: angles of the generators' E', shape (n, n_gen), rad.
            voltages: of the network buses, shape (n, n_network), pu.
        """
        place = {bus.id: i for i, bus in enumerate(self.case.buses)}
        angles = np.zeros((len(theta), len(self.case.buses)))
        angles[:, [place[g] for g in self.case.generators]] = theta
        angles[:, [place[bus.id] for bus in self.data.buses]] = np.unwrap(np.angle(voltages), axis=0)
        return angles

    def _slopes(self, theta: Array, voltage: Array, active: Array) -> _Slopes:
        n, e = len(active), self._emf_at(theta)
        v = voltage[:n] + 1j * voltage[n:]
        power = active + 1j * self.reactive
        slope = np.diag(-np.conj(power / v**2))  # ∂i/∂conj(v)
        i_by_v = np.block([[slope.real, slope.imag], [slope.imag, -slope.real]])
        i_by_active = _real(np.diag(1 / np.conj(v)))[:, :n]
        e_by_angle = np.concatenate([np.diag(-e.imag), np.diag(e.real)])[:, :-1]
        by_load, load_current = _real(self._by_load[self.loads]), _real(self._load_current)
        current = self._own_current @ e + self._load_current @ np.conj(power / v)
        along = np.hstack([np.diag(e.real), np.diag(e.imag)])  # p = Re(e conj(i))
        turned = np.diag((1j * e * np.conj(current)).real)[:, :-1]
        return _Slopes(
            v_by_v=np.eye(2 * n) - by_load @ i_by_v,
            v_by_angle=-_real(self._by_emf[self.loads]) @ e_by_angle,
            v_by_active=-by_load @ i_by_active,
            p_by_v=along @ load_current @ i_by_v,
            p_by_angle=turned + along @ _real(self._own_current) @ e_by_angle,
            p_by_active=along @ load_current @ i_by_active,
        )

    def _guess(self, theta: Array, active: Array) -> Array:
        """Voltages under loads of constant impedance, which always exist, shape (2 n_load,), pu."""
        admittance = np.conj(active + 1j * self.reactive) / self._magnitude**2
        system = np.eye(len(active)) - self._by_load[self.loads] * admittance
        v = np.linalg.solve(system, self._by_emf[self.loads] @ self._emf_at(theta))
        return np.concatenate([v.real, v.imag])

    def _emf_at(self, theta: Array) -> Complex:
        """E' of all machines, shape (..., n_machine), pu."""
        slack = np.zeros((*theta.shape[:-1], 1))
        return np.asarray(self.emf * np.exp(1j * np.concatenate([theta, slack], axis=-1)))


def _real(matrix: Complex) -> Array:
    """A complex matrix that acts on vectors of real parts, then imaginary parts."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])
