"""The equations of the plant once, symbolically: machines, controls and network balance with their Jacobians.

For linearisation, collocation and tests; the compiled ones for simulation are in `equations`. Sources: the
models GENROU, GENCLS, SEXS, IEEEX1, ST2CUT and TGOV1 as power-system simulators have them (P. W. Sauer, M. A.
Pai, Power System Dynamics and Stability; IEEE Std 421.5).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi
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
    LEAD_A,
    LEAD_B,
    N_STATES,
    SPEED,
    TURBINE,
    WASHOUT,
    MachineArrays,
)
from ded_bench.plants.detailed.power_flow import PortNetwork
from ded_bench.plants.time_varying import Indices


class SymbolicPlant(NamedTuple):
    """The plant as CasADi functions of (x, v, p_ref, drawn, v_ref).

    x are the states of all machines, (N_STATES · n,), state after state; v the voltages at the ports, real
    and imaginary parts in turn, (2 n_port,), pu; p_ref the governors' references, (n,), pu; drawn the active
    powers of loads at the ports, (n_port,), pu; v_ref the exciters' references, (n,), pu.
    """

    equations: casadi.Function  # to x' (N_STATES · n,), current balance (2 n_port,), p_e (n,), p_m (n,)
    jacobian: casadi.Function  # of all these, stacked, by (x, v)


def symbolic_plant(data: MachineArrays, network: PortNetwork) -> SymbolicPlant:
    """Write the equations of all machines and the network."""
    n, n_port = len(data.port), len(network.ports)
    x, v = casadi.SX.sym("x", N_STATES * n), casadi.SX.sym("v", 2 * n_port)
    p_ref, drawn, v_ref = (casadi.SX.sym(name, size) for name, size in (("p", n), ("l", n_port), ("r", n)))
    states = casadi.reshape(x, n, N_STATES)
    s = [states[:, i] for i in range(N_STATES)]
    v_re, v_im = v[0::2], v[1::2]
    at_re, at_im = v_re[data.port.tolist()], v_im[data.port.tolist()]
    sin, cos = casadi.sin(s[DELTA]), casadi.cos(s[DELTA])
    v_d, v_q = at_re * sin - at_im * cos, at_re * cos + at_im * sin
    psi_d = data.gd1 * s[E1Q] + (1 - data.gd1) * s[E2D]
    psi_q = data.gq1 * s[E1D] + (1 - data.gq1) * s[E2Q]
    i_d, i_q = (psi_d - v_q) / data.x, (v_d - psi_q) / data.x
    rates, p_e, p_m = _rates(data, s, (i_d, i_q), (v_d, v_q), (p_ref, v_ref))
    # Out of dq: the current's frame is turned by delta - pi/2.
    i_re, i_im = i_d * sin + i_q * cos, i_q * sin - i_d * cos
    y = network.admittance
    size = v_re**2 + v_im**2
    into = _sparse_sum(data.port, n_port)
    g, b = casadi.DM(np.real(y)), casadi.DM(np.imag(y))
    q = network.q_drawn
    balance_re = into @ i_re - (drawn * v_re + q * v_im) / size - (g @ v_re - b @ v_im)
    balance_im = into @ i_im - (drawn * v_im - q * v_re) / size - (g @ v_im + b @ v_re)
    balance = casadi.reshape(casadi.horzcat(balance_re, balance_im).T, 2 * n_port, 1)
    inputs = [x, v, p_ref, drawn, v_ref]
    outputs = [casadi.vertcat(*rates), balance, p_e, p_m]
    jacobian = casadi.jacobian(casadi.vertcat(*outputs), casadi.vertcat(x, v))
    return SymbolicPlant(
        casadi.Function("equations", inputs, outputs), casadi.Function("jacobian", inputs, [jacobian])
    )


def _rates(
    data: MachineArrays,
    s: list[casadi.SX],
    current: tuple[Any, Any],
    voltage: tuple[Any, Any],
    references: tuple[casadi.SX, casadi.SX],
) -> tuple[list[Any], Any, Any]:
    """Rates of all states, electrical powers, turbines' powers."""
    (i_d, i_q), (v_d, v_q), (p_ref, v_ref) = current, voltage, references
    v, p_e = casadi.sqrt(v_d**2 + v_q**2), v_d * i_d + v_q * i_q
    w = s[SPEED]
    after = data.ks * w - s[WASHOUT]
    lead = data.lead_a * (after - s[LEAD_A]) + s[LEAD_A]
    v_s = data.lead_b * (lead - s[LEAD_B]) + s[LEAD_B]
    feedback = data.dc * data.lead * (s[FIELD] - s[FEEDBACK])
    u = v_ref - v - feedback + v_s
    static = data.gain * (data.lead * (u - s[EXCITER]) + s[EXCITER])
    drive = data.dc * s[EXCITER] + (1 - data.dc) * static
    i_fd = s[E1Q] + (data.xd - data.xd1) * (data.gd1 * i_d - data.gd2 * (s[E2D] - s[E1Q]))
    i_1q = s[E1D] + (data.xq - data.xq1) * (-data.gq1 * i_q + data.gq2 * (s[E1D] - s[E2Q]))
    p_m = data.reheat * (s[GATE] - s[TURBINE]) + s[TURBINE]
    turning = data.inverse_m * (p_m - p_e - data.d * w)
    rates: list[Any] = [None] * N_STATES
    rates[DELTA] = data.omega_0 * w
    rates[SPEED] = turning
    rates[E1Q] = data.rate_d1 * (s[FIELD] - i_fd)
    rates[E1D] = -data.rate_q1 * i_1q
    rates[E2D] = data.rate_d2 * (s[E1Q] - s[E2D] - (data.xd1 - data.xl) * i_d)
    rates[E2Q] = data.rate_q2 * (s[E1D] - s[E2Q] + (data.xq1 - data.xl) * i_q)
    rates[EXCITER] = data.rate_x * ((data.dc * data.gain + 1 - data.dc) * u - s[EXCITER])
    rates[FIELD] = data.rate_f * (drive - data.ke * s[FIELD])
    rates[FEEDBACK] = data.rate_fb * (s[FIELD] - s[FEEDBACK])
    rates[WASHOUT] = data.rate_w * after
    rates[LEAD_A] = data.rate_a * (after - s[LEAD_A])
    rates[LEAD_B] = data.rate_b * (lead - s[LEAD_B])
    rates[GATE] = data.rate_g * (p_ref - data.droop * w - s[GATE])
    rates[TURBINE] = data.rate_h * (s[GATE] - s[TURBINE])
    return rates, p_e, p_m


def _sparse_sum(port: Indices, n_port: int) -> casadi.DM:
    """Sums over the machines of each port, (n_port, n)."""
    return casadi.DM.triplet(
        port.tolist(), list(range(len(port))), casadi.DM.ones(len(port)), n_port, len(port)
    )
