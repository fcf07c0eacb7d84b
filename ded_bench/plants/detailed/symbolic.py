"""The equations of the plant once, symbolically: machines, controls and network balance with their Jacobians.

For linearisation, collocation (in Pyomo) and tests; `equations` has rates, and all compiled for simulation.
Sources: the models GENROU, GENCLS, SEXS, IEEEX1, ST2CUT and TGOV1 as power-system simulators have them
(P. W. Sauer, M. A. Pai, Power System Dynamics and Stability; IEEE Std 421.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi
import numpy as np

from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.equations import set_rates
from ded_bench.plants.detailed.power_flow import PortNetwork


class Equations(NamedTuple):
    """The plant at one state, in any algebra."""

    rates: list[Any]  # x' of each state, (n,)
    balance: tuple[Any, Any]  # real and imaginary currents that are left over at the ports, (n_port,)
    p_e: Any  # electrical powers, (n,), pu
    p_m: Any  # turbines' powers, (n,), pu


class SymbolicPlant(NamedTuple):
    """The plant as CasADi functions of (x, v, p_ref, drawn, v_ref).

    x are the states of all machines, (N_STATES · n,), state after state; v the voltages at the ports, real
    and imaginary parts in turn, (2 n_port,), pu; p_ref the governors' references, (n,), pu; drawn the active
    powers of loads at the ports, (n_port,), pu; v_ref the exciters' references, (n,), pu.
    """

    equations: casadi.Function  # to x' (N_STATES · n,), current balance (2 n_port,), p_e (n,), p_m (n,)
    jacobian: casadi.Function  # of all these, stacked, by (x, v)


def symbolic_plant(data: at.MachineArrays, network: PortNetwork) -> SymbolicPlant:
    """Write the equations of all machines and the network for CasADi."""
    n, n_port = len(data.port), len(network.ports)
    x, v = casadi.SX.sym("x", at.N_STATES * n), casadi.SX.sym("v", 2 * n_port)
    p_ref, drawn, v_ref = (casadi.SX.sym(name, size) for name, size in (("p", n), ("l", n_port), ("r", n)))
    states = casadi.reshape(x, n, at.N_STATES)
    s = [states[:, i] for i in range(at.N_STATES)]
    found = plant_equations(data, network, s, (v[0::2], v[1::2]), (p_ref, drawn, v_ref), casadi)
    balance = casadi.reshape(casadi.horzcat(*found.balance).T, 2 * n_port, 1)
    inputs = [x, v, p_ref, drawn, v_ref]
    outputs = [casadi.vertcat(*found.rates), balance, found.p_e, found.p_m]
    jacobian = casadi.jacobian(casadi.vertcat(*outputs), casadi.vertcat(x, v))
    equations = casadi.Function("equations", inputs, outputs)
    return SymbolicPlant(equations, casadi.Function("jacobian", inputs, [jacobian]))


def plant_equations(
    data: at.MachineArrays,
    network: PortNetwork,
    s: Sequence[Any],
    voltage: tuple[Any, Any],
    inputs: tuple[Any, Any, Any],
    functions: Any,
) -> Equations:
    """Write the equations of all machines and the network at one state.

    Args:
        data: of n machines.
        network: between n_port ports.
        s: the states, each of shape (n,).
        voltage: real and imaginary parts at the ports, (n_port,), pu.
        inputs: references of governors, (n,), powers drawn at the ports, (n_port,), and references of
            exciters, (n,), pu.
        functions: has `sin`, `cos` and `sqrt` of the algebra that all these are written in.
    """
    (v_re, v_im), (p_ref, drawn, v_ref) = voltage, inputs
    ports = data.port.tolist()
    at_re, at_im = v_re[ports], v_im[ports]
    sin, cos = functions.sin(s[at.DELTA]), functions.cos(s[at.DELTA])
    v_d, v_q = at_re * sin - at_im * cos, at_re * cos + at_im * sin
    psi_d = data.gd1 * s[at.E1Q] + (1 - data.gd1) * s[at.E2D]
    psi_q = data.gq1 * s[at.E1D] + (1 - data.gq1) * s[at.E2Q]
    i_d, i_q = (psi_d - v_q) / data.x, (v_d - psi_q) / data.x
    size = functions.sqrt(v_d**2 + v_q**2)
    p_e, p_m = v_d * i_d + v_q * i_q, data.reheat * (s[at.GATE] - s[at.TURBINE]) + s[at.TURBINE]
    rates: list[Any] = [None] * at.N_STATES
    set_rates(data, s, (i_d, i_q), size, (p_ref, v_ref), p_e, rates)
    # Out of dq: the current's frame is turned by delta - pi/2.
    i_re, i_im = i_d * sin + i_q * cos, i_q * sin - i_d * cos
    y, q, square = network.admittance, network.q_drawn, v_re**2 + v_im**2
    into = (np.arange(len(y))[:, None] == data.port).astype(float)
    g, b = np.real(y), np.imag(y)
    balance_re = into @ i_re - (drawn * v_re + q * v_im) / square - (g @ v_re - b @ v_im)
    balance_im = into @ i_im - (drawn * v_im - q * v_re) / square - (g @ v_im + b @ v_re)
    return Equations(rates, (balance_re, balance_im), p_e, p_m)
