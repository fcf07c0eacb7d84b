"""The equilibrium of a solved power flow: states of machines and controls, and the exciters' references."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
)
from ded_bench.plants.detailed.power_flow import OperatingPoint
from ded_bench.problem.quantities import Array


class Equilibrium(NamedTuple):
    """Where everything rests."""

    x: Array  # states, (N_STATES, n_machine)
    v_ref: Array  # (n_machine,), pu


def equilibrium(data: MachineArrays, point: OperatingPoint) -> Equilibrium:
    """States at rest; the inertia-weighted mean of rotor angles is zero, so voltages turn with them.

    A classical machine keeps its voltage behind x'd as `e1q`; a machine without exciter its field voltage.
    """
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
