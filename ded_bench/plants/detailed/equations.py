"""The equations of the plant for simulation: machines with controls, and the network's voltages; compiled.

The same equations stand symbolically in `symbolic`. Voltages are real and imaginary parts in turn, in a frame
that turns with the inertia-weighted mean of the rotor angles, so that they change slowly.

A machine is a constant admittance 1 / (j x) with a current source beside it, so that only the loads make the
network's equations nonlinear. With slopes J of the loads' currents I(v) at some earlier voltages,

    v = W (s + I(v) - J v),    W = (Y - J)⁻¹,

s being the sources: a fixed point whose contraction is as small as the change of voltages and loads since
then. W is renewed where it converges slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.machine_arrays import MachineArrays
from ded_bench.problem.compiled import compiled
from ded_bench.problem.quantities import Array

#: The fixed point gives up after so many steps, Newton's method, which renews W in each, after so many.
FIXED_POINT_STEPS, NEWTON_STEPS = 12, 20


class CompiledNetwork(NamedTuple):
    """The network between its ports, of which the first n_load have loads."""

    transposed: Array  # admittances, with those of machines, as real numbers, (2 n_port, 2 n_port), pu
    q_drawn: Array  # (n_load,), pu
    change: float  # of voltages in a fixed-point step, at which it ends, pu


class LoadSlopes(NamedTuple):
    """The loads' currents linearised, and the network's answer with them."""

    slopes: Array  # J: (re by re, re by im, im by re, im by im) of each load, (n_load, 4)
    answer: Array  # Wᵀ, (2 n_port, 2 n_port)


@compiled
def renew(network: CompiledNetwork, drawn: Array, v: Array, load: LoadSlopes) -> None:
    """Linearise the loads at voltages v, (2 n_port,); LinAlgError if the network has no answer there."""
    matrix = network.transposed.copy()
    for i in range(len(drawn)):
        p, q, re, im = drawn[i], network.q_drawn[i], v[2 * i], v[2 * i + 1]
        square = re * re + im * im
        along, across = 2.0 * (p * re + q * im) / square**2, 2.0 * (p * im - q * re) / square**2
        load.slopes[i, 0] = along * re - p / square
        load.slopes[i, 1] = along * im - q / square
        load.slopes[i, 2] = across * re + q / square
        load.slopes[i, 3] = across * im - p / square
        for row in range(2):
            for column in range(2):
                matrix[2 * i + column, 2 * i + row] -= load.slopes[i, 2 * row + column]
    load.answer[:] = np.linalg.inv(matrix)


@compiled
def sources(data: MachineArrays, x: Array, source: Array) -> None:
    """Set the machines' current sources at all ports, (2 n_port,), pu, from the states, (N_STATES, n)."""
    source[:] = 0.0
    turn = mean_angle(data, x)
    for i in range(x.shape[1]):
        psi_d = data[i].gd1 * x[at.E1Q, i] + (1.0 - data[i].gd1) * x[at.E2D, i]
        psi_q = data[i].gq1 * x[at.E1D, i] + (1.0 - data[i].gq1) * x[at.E2Q, i]
        sin, cos = np.sin(x[at.DELTA, i] - turn), np.cos(x[at.DELTA, i] - turn)
        source[2 * data[i].port] += (psi_d * sin - psi_q * cos) / data[i].x
        source[2 * data[i].port + 1] -= (psi_q * sin + psi_d * cos) / data[i].x


@compiled
def mean_angle(data: MachineArrays, x: Array) -> float:
    """The inertia-weighted mean of the rotor angles, rad; that of the infinite machine where there is one."""
    mean = 0.0
    for i in range(x.shape[1]):
        mean += data[i].inertia * x[at.DELTA, i]
    return mean


@compiled
def solve_voltages(
    network: CompiledNetwork, drawn: Array, source: Array, load: LoadSlopes, v: Array, most: int
) -> int:
    """Find the voltages at all ports, (2 n_port,), pu.

    Args:
        network: between ports.
        drawn: active powers of the loads, (n_load,), pu.
        source: of the machines, (2 n_port,), pu.
        load: their slopes; not changed.
        v: a guess at ports with loads, and receives the answer at all.
        most: steps.

    Returns:
        The number of steps; more than `most` where they do not converge.
    """
    n, n_all = 2 * len(drawn), len(v)
    base, new, current = np.zeros(n_all), np.empty(n_all), np.empty(n)
    for j in range(n_all):
        if source[j] != 0.0:
            row, factor = load.answer[j], source[j]
            for i in range(n_all):
                base[i] += row[i] * factor
    for step in range(1, most + 1):
        for i in range(len(drawn)):
            p, q, re, im = drawn[i], network.q_drawn[i], v[2 * i], v[2 * i + 1]
            square = re * re + im * im
            slope = load.slopes[i]
            current[2 * i] = -(p * re + q * im) / square - slope[0] * re - slope[1] * im
            current[2 * i + 1] = -(p * im - q * re) / square - slope[2] * re - slope[3] * im
        new[:n] = base[:n]
        for j in range(n):
            row, factor = load.answer[j], current[j]
            for i in range(n):
                new[i] += row[i] * factor
        worst = 0.0
        for i in range(n):
            off = abs(new[i] - v[i])
            if not off < np.inf:
                return most + 1
            worst = max(worst, off)
            v[i] = new[i]
        if worst < network.change:
            v[n:] = base[n:]
            for j in range(n):
                row, factor = load.answer[j], current[j]
                for i in range(n, n_all):
                    v[i] += row[i] * factor
            return step
    return most + 1


@compiled
def solve_afresh(network: CompiledNetwork, drawn: Array, source: Array, load: LoadSlopes, v: Array) -> bool:
    """As `solve_voltages`, by Newton's method, and tell whether there is a solution; slopes are renewed."""
    for _ in range(NEWTON_STEPS):
        renew(network, drawn, v, load)
        if solve_voltages(network, drawn, source, load, v, 1) == 1:
            return True
    return False


@compiled
def machine_rates(
    data: MachineArrays, x: Array, v: Array, p_ref: Array, v_ref: Array, rates: Array, p_e: Array
) -> None:
    """Set the rates of all states and the electrical powers.

    Args:
        data: of n machines.
        x: states, (N_STATES, n).
        v: voltages at all ports, (2 n_port,), pu.
        p_ref: the governors' references, (n,), pu.
        v_ref: the exciters' references, (n,), pu.
        rates: receives x', (N_STATES, n), 1/s.
        p_e: receives the powers into the network, (n,), pu.
    """
    turn = mean_angle(data, x)
    for i in range(x.shape[1]):
        w = x[at.SPEED, i]
        e1q, e1d, e2d, e2q = x[at.E1Q, i], x[at.E1D, i], x[at.E2D, i], x[at.E2Q, i]
        re, im = v[2 * data[i].port], v[2 * data[i].port + 1]
        sin, cos = np.sin(x[at.DELTA, i] - turn), np.cos(x[at.DELTA, i] - turn)
        v_d, v_q = re * sin - im * cos, re * cos + im * sin
        i_d = (data[i].gd1 * e1q + (1.0 - data[i].gd1) * e2d - v_q) / data[i].x
        i_q = (v_d - data[i].gq1 * e1d - (1.0 - data[i].gq1) * e2q) / data[i].x
        p_e[i] = v_d * i_d + v_q * i_q
        p_m = data[i].reheat * (x[at.GATE, i] - x[at.TURBINE, i]) + x[at.TURBINE, i]
        rates[at.DELTA, i] = data[i].omega_0 * w
        rates[at.SPEED, i] = data[i].inverse_m * (p_m - p_e[i] - data[i].d * w)
        i_fd = data[i].gd1 * i_d + data[i].gd2 * (e1q - e2d)
        i_fd = e1q + (data[i].xd - data[i].xd1) * i_fd
        i_1q = data[i].gq2 * (e1d - e2q) - data[i].gq1 * i_q
        i_1q = e1d + (data[i].xq - data[i].xq1) * i_1q
        rates[at.E1Q, i] = data[i].rate_d1 * (x[at.FIELD, i] - i_fd)
        rates[at.E1D, i] = -data[i].rate_q1 * i_1q
        rates[at.E2D, i] = data[i].rate_d2 * (e1q - e2d - (data[i].xd1 - data[i].xl) * i_d)
        rates[at.E2Q, i] = data[i].rate_q2 * (e1d - e2q + (data[i].xq1 - data[i].xl) * i_q)
        after = data[i].ks * w - x[at.WASHOUT, i]
        between = data[i].lead_a * (after - x[at.LEAD_A, i]) + x[at.LEAD_A, i]
        v_s = data[i].lead_b * (between - x[at.LEAD_B, i]) + x[at.LEAD_B, i]
        rates[at.WASHOUT, i] = data[i].rate_w * after
        rates[at.LEAD_A, i] = data[i].rate_a * (after - x[at.LEAD_A, i])
        rates[at.LEAD_B, i] = data[i].rate_b * (between - x[at.LEAD_B, i])
        u = v_ref[i] - np.sqrt(re * re + im * im) + v_s
        if data[i].dc > 0.0:
            u -= data[i].lead * (x[at.FIELD, i] - x[at.FEEDBACK, i])
            rates[at.EXCITER, i] = data[i].rate_x * (data[i].gain * u - x[at.EXCITER, i])
            rates[at.FIELD, i] = data[i].rate_f * (x[at.EXCITER, i] - data[i].ke * x[at.FIELD, i])
        else:
            into = data[i].gain * (data[i].lead * (u - x[at.EXCITER, i]) + x[at.EXCITER, i])
            rates[at.EXCITER, i] = data[i].rate_x * (u - x[at.EXCITER, i])
            rates[at.FIELD, i] = data[i].rate_f * (into - x[at.FIELD, i])
        rates[at.FEEDBACK, i] = data[i].rate_fb * (x[at.FIELD, i] - x[at.FEEDBACK, i])
        rates[at.GATE, i] = data[i].rate_g * (p_ref[i] - data[i].droop * w - x[at.GATE, i])
        rates[at.TURBINE, i] = data[i].rate_h * (x[at.GATE, i] - x[at.TURBINE, i])
