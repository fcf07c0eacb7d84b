"""Network and machines of one case together: power flow, equilibrium, linearisation and its modes."""

from __future__ import annotations

import functools
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.plants.detailed.equilibrium import Equilibrium, equilibrium
from ded_bench.plants.detailed.machine_arrays import DELTA, MachineArrays, machine_arrays, moving
from ded_bench.plants.detailed.power_flow import Complex, OperatingPoint, PortNetwork, port_network
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.quantities import Array

if TYPE_CHECKING:
    from ded_bench.plants.detailed.equations import CompiledNetwork
    from ded_bench.plants.detailed.symbolic import SymbolicPlant

#: Change of voltages in a fixed-point step at which it ends, pu: a tenth of it, or less, is left.
CHANGE = 1e-10
#: Step of differences between states, which are of the order of one.
DIFFERENCE = 1e-6


class Slopes(NamedTuple):
    """Derivatives by the states that move, with voltages eliminated."""

    rates: Array  # (n_moving, n_moving), 1/s
    p_e: Array  # electrical powers, (n_machine, n_moving), pu
    p_m: Array  # turbines' powers, (n_machine, n_moving), pu


@dataclass(frozen=True, eq=False)
class PowerSystem:
    """Equations of one case; a machine keeps its speed where the slack is infinite, none on an island."""

    network: PortNetwork
    data: MachineArrays

    @staticmethod
    def of(network: Any, machines: Any, island: bool, loads: Collection[str] = ()) -> PowerSystem:
        """Build it from the records of network.json and machines.json; `loads` as in `port_network`."""
        ac = port_network(network, machines, loads)
        infinite = None if island else machines.machines[ac.balancing].name
        return PowerSystem(ac, machine_arrays(machines, ac.machine_port, infinite))

    @property
    def island(self) -> bool:
        """Whether every machine can change its speed."""
        return bool((self.data.inverse_m > 0.0).all())

    @functools.cached_property
    def moving(self) -> Indices:
        """See `machine_arrays.moving`."""
        return moving(self.data)

    @functools.cached_property
    def symbolic(self) -> SymbolicPlant:
        """The equations with their Jacobians."""
        from ded_bench.plants.detailed.symbolic import symbolic_plant  # CasADi: simulation does without

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
        """Size of the fastest mode at the nominal point, 1/s, from differences of the compiled equations."""
        from ded_bench.plants.detailed.equations import rates_at

        point = self.network.nominal()
        rest = self.equilibrium(point)
        turned = point.voltage * np.exp(-1j * (self.data.inertia @ rest.x[DELTA]))
        n = len(self.moving)
        x = np.tile(rest.x, (2, n, 1, 1))
        steps = x.reshape(2, n, -1)[:, np.arange(n), self.moving]
        steps += np.array([[DIFFERENCE], [-DIFFERENCE]])
        x.reshape(2, n, -1)[:, np.arange(n), self.moving] = steps
        drawn = point.p_drawn[: self.network.n_load_port]
        references = np.stack([point.power.real, rest.v_ref])
        given = self.data, self.compiled_network, drawn, references
        rates = rates_at(*given, x.reshape(-1, *rest.x.shape), interleaved(turned)).reshape(x.shape)
        slopes = (rates[0] - rates[1]).reshape(n, -1)[:, self.moving] / (2.0 * DIFFERENCE)
        return float(np.abs(np.linalg.eigvals(slopes)).max())

    def equilibrium(self, point: OperatingPoint) -> Equilibrium:
        """See `equilibrium`."""
        return equilibrium(self.data, point)

    def slopes(self, x: Array, voltage: Complex, p_drawn: Array) -> Slopes:
        """Linearise at states (N_STATES, n_machine) and voltages (n_port,), pu."""
        n, n_v = len(self.data.port), 2 * len(voltage)
        references = np.zeros(n)  # they enter linearly
        given = x.ravel(), interleaved(voltage), references, p_drawn, references
        full = self.symbolic.jacobian(*given).sparse().tocsr()
        columns, by_v = full[:, : x.size].tocsc()[:, self.moving].toarray(), full[:, x.size :]
        balance = slice(x.size, x.size + n_v)
        reduced = columns + by_v @ np.linalg.solve(by_v[balance].toarray(), -columns[balance])
        outputs = reduced[x.size + n_v :]
        return Slopes(reduced[self.moving], outputs[:n], outputs[n:])

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
