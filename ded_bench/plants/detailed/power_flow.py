"""The AC network between its ports, and its power flow.

A port is a bus with a machine or a load; all others carry no current and are eliminated (Kron), which is
exact. Loads draw constant P and Q. Everything is in pu of the network's base power.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, dgetrs

from ded_bench.plants.plant import SimulationError
from ded_bench.problem.quantities import Array, Indices

Complex = NDArray[np.complex128]

#: Added to r and x of every line, as the field's simulator ANDES does, with which this plant is compared:
#: without it, powers of the slack differ by up to 8e-6 pu.
LINE_EPSILON = 1e-8
#: Newton stops at this mismatch, pu, and gives up after so many steps.
MISMATCH, NEWTON_STEPS = 1e-11, 60
#: Derivatives are renewed where a step leaves more of the mismatch than this.
KEPT = 0.1


class OperatingPoint(NamedTuple):
    """A solved power flow."""

    voltage: Complex  # at the ports, (n_port,), pu; the balancing machine's bus has angle 0
    power: Complex  # P + jQ out of every machine, (n_machine,), pu
    p_drawn: Array  # active power drawn at the ports, (n_port,), pu


@dataclass(frozen=True, eq=False)
class PortNetwork:
    """Admittances between ports, what is drawn there nominally, and where machines stand."""

    buses: tuple[str, ...]
    ports: Indices  # (n_port,): their buses, first those with a load
    n_load_port: int
    admittance: Complex  # (n_port, n_port), pu
    spread: Complex  # voltages of all buses by those of ports, (n_bus, n_port)
    p_drawn: Array  # nominal active power drawn at the ports, (n_port,), pu
    q_drawn: Array  # reactive power, always, (n_port,), pu
    machine_port: Indices  # (n_machine,): the port of each machine
    share: Array  # (n_machine,): of what machines at its bus deliver together
    p_nominal: Array  # (n_machine,), pu, of the rounded power flow in the data
    guess: Complex  # voltages of that power flow, (n_port,), pu; magnitudes at machines are held
    balancing: int  # the machine that balances the power flow, alone at its bus

    def power_flow(
        self, p_machine: Array, p_drawn: Array, guess: Complex | None = None, sizes: Array | None = None
    ) -> OperatingPoint:
        """Solve for voltages, with magnitudes held where machines are; one machine's power follows.

        Newton's method in polar coordinates; derivatives stay while they lead on fast.

        Args:
            p_machine: active power, (n_machine,), pu; that of the balancing one is not looked at.
            p_drawn: active power that loads draw at the ports, (n_port,), pu.
            guess: voltages to start from, (n_port,), pu; default: nominal.
            sizes: magnitudes, which are held where machines are, (n_port,), pu; default: nominal.

        Raises:
            SimulationError: there is no solution.
        """
        unknown, held = self._unknown, self.machine_port
        wanted = np.zeros(len(self.ports))
        np.add.at(wanted, self.machine_port, p_machine)
        wanted -= p_drawn
        start = self.guess if guess is None else guess
        angle, size = np.angle(start), np.abs(start)
        size[held] = np.abs(self.guess[held]) if sizes is None else sizes[held]
        balancing, factors, before = self.machine_port[self.balancing], None, np.inf
        for _ in range(NEWTON_STEPS):
            voltage = size * np.exp(1j * (angle - angle[balancing]))
            injected = voltage * (self.admittance @ voltage).conj()
            off = np.concatenate([injected.real - wanted, injected.imag + self.q_drawn])[unknown]
            worst = np.abs(off).max(initial=0.0)
            if worst < MISMATCH:
                delivered = injected[held] + (p_drawn + 1j * self.q_drawn)[held]
                power = p_machine + 1j * self.share * delivered.imag
                power[self.balancing] = delivered[self.balancing]
                return OperatingPoint(voltage, power, p_drawn)
            if not worst < np.inf:
                break
            if factors is None or worst > KEPT * before:
                *factors, singular = dgetrf(self._slopes(voltage, injected)[np.ix_(unknown, unknown)])
                if singular:
                    break
            step = np.zeros(2 * len(wanted))
            step[unknown], before = dgetrs(*factors, off)[0], worst
            angle -= step[: len(wanted)]
            size -= step[len(wanted) :]
        raise SimulationError("the power flow has no solution")

    def nominal(self) -> OperatingPoint:
        """The power flow of the data, solved again: its rounded one is no equilibrium."""
        return self.power_flow(self.p_nominal, self.p_drawn)

    def balance_slopes(self, point: OperatingPoint) -> Array:
        """How the balancing machine's power changes with active powers of the machines, losses included.

        Returns:
            (n_machine,), zero for the balancing one, about -1 for all others.
        """
        injected = point.voltage * (self.admittance @ point.voltage).conj()
        slopes, balancing = self._slopes(point.voltage, injected), self.machine_port[self.balancing]
        jacobian = slopes[np.ix_(self._unknown, self._unknown)]
        by_all = np.zeros(len(slopes))
        by_all[self._unknown] = np.linalg.solve(jacobian.T, slopes[balancing, self._unknown])
        return by_all[self.machine_port]

    @functools.cached_property
    def _unknown(self) -> Indices:
        """Which of all angles and magnitudes, (2 n_port,), a power flow solves for: those not held."""
        n = len(self.ports)
        return np.setdiff1d(np.arange(2 * n), [self.machine_port[self.balancing], *(n + self.machine_port)])

    def _slopes(self, voltage: Complex, injected: Complex) -> Array:
        """Derivatives of injected P, Q by angles and magnitudes, (2 n_port, 2 n_port)."""
        n, coupled = len(voltage), voltage[:, None] * (self.admittance * voltage).conj()
        by_angle, by_size = -1j * coupled, coupled / np.abs(voltage)
        diagonal = np.arange(n)
        by_angle[diagonal, diagonal] += 1j * injected
        by_size[diagonal, diagonal] += injected / np.abs(voltage)
        slopes = np.empty((2 * n, 2 * n))
        slopes[:n, :n], slopes[:n, n:] = by_angle.real, by_size.real
        slopes[n:, :n], slopes[n:, n:] = by_angle.imag, by_size.imag
        return slopes


def port_network(network: Any, machines: Any, loads: Collection[str] = ()) -> PortNetwork:
    """Build the network of a case's records.

    Args:
        network: its buses and lines.
        machines: whose buses are ports.
        loads: buses that may draw power though they draw none nominally; all that do are ports, too.
    """
    index = {bus.id: i for i, bus in enumerate(network.buses)}
    full = np.zeros((len(index), len(index)), dtype=complex)
    for bus in network.buses:
        full[index[bus.id], index[bus.id]] += bus.gs + 1j * bus.bs
    for line in network.lines:
        near, far = index[line.from_bus], index[line.to_bus]
        series = 1.0 / (line.r + LINE_EPSILON + 1j * (line.x + LINE_EPSILON))
        own, tap = series + 0.5j * line.b, line.tap * np.exp(1j * np.radians(line.shift_deg))
        full[near, near] += own / abs(tap) ** 2
        full[far, far] += own
        full[near, far] -= series / np.conj(tap)
        full[far, near] -= series / tap
    stations = [machine.bus for machine in machines.machines]
    # A bus without machines that feeds in is a negative load; with machines, pg and qg are theirs.
    drawn = np.array([
        bus.pd + 1j * bus.qd - (0.0 if bus.id in stations else bus.pg + 1j * bus.qg) for bus in network.buses
    ])  # fmt: skip
    drawing = [i for i, bus in enumerate(network.buses) if drawn[i] != 0.0 or bus.id in loads]
    ports = np.array([*drawing, *sorted({index[bus] for bus in stations} - set(drawing))])
    inner = np.setdiff1d(np.arange(len(index)), ports)
    spread = np.zeros((len(index), len(ports)), dtype=complex)
    spread[ports] = np.eye(len(ports))
    spread[inner] = -np.linalg.solve(full[np.ix_(inner, inner)], full[np.ix_(inner, ports)])
    at_ports = [network.buses[i] for i in ports]
    place = {bus.id: port for port, bus in enumerate(at_ports)}
    generated = {bus.id: bus.pg for bus in network.buses}
    return PortNetwork(
        buses=tuple(index),
        ports=ports,
        n_load_port=len(drawing),
        admittance=full[ports] @ spread,
        spread=spread,
        p_drawn=drawn[ports].real,
        q_drawn=drawn[ports].imag,
        machine_port=np.array([place[m.bus] for m in machines.machines]),
        share=np.array([m.share for m in machines.machines]),
        p_nominal=np.array([m.share * generated[m.bus] for m in machines.machines]),
        guess=np.array([bus.v * np.exp(1j * np.radians(bus.angle_deg)) for bus in at_ports]),
        balancing=stations.index(network.slack_machine_bus),
    )
