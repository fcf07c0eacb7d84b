"""The equations of the plant for simulation: machines with controls, and the network's voltages; compiled.

Those of a machine serve `symbolic`, too. Voltages are real and imaginary parts in turn, in a frame
that turns with the inertia-weighted mean of the rotor angles, so that they change slowly.

A machine is a constant admittance 1 / (j x) with a current source beside it, so that only the loads make the
network's equations nonlinear. With slopes J of the loads' currents I(v) at some earlier voltages,

    v = W (s + I(v) - J v),    W = (Y - J)⁻¹,

s being the sources: a fixed point whose contraction is as small as the change of voltages and loads since
then. W is renewed where it converges slowly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.machine_arrays import MachineArrays
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Array, Indices

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
    inverse = np.linalg.inv(matrix)
    for j in range(len(matrix)):
        copy_row(inverse[j], load.answer[j])


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
def observed(data: MachineArrays, x: Array, machines: Indices) -> tuple[Array, float]:
    """Of some machines angles from the mean, rad, speeds, rad/s, turbines' powers, pu, (3, n); the mean."""
    mean, found = mean_angle(data, x), np.empty((3, len(machines)))
    for j, i in enumerate(machines):
        found[0, j], found[1, j] = x[at.DELTA, i] - mean, x[at.SPEED, i] * data[i].omega_0
        found[2, j] = data[i].reheat * x[at.GATE, i] + (1.0 - data[i].reheat) * x[at.TURBINE, i]
    return found, mean


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
        for i in range(n):
            new[i] = base[i]
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
            for i in range(n, n_all):
                v[i] = base[i]
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


def set_rates(
    m: Any, s: Any, current: tuple[Any, Any], v: Any, references: tuple[Any, Any], p_e: Any, rates: Any
) -> None:
    """Set the rates of all states of a machine, in any algebra, or of several.

    Args:
        m: its constants.
        s: its states, (N_STATES,).
        current: into the network, d and q, pu.
        v: size of its bus's voltage, pu.
        references: of governor and exciter, pu.
        p_e: power into the network, pu.
        rates: receives the rates, (N_STATES,), 1/s.
    """
    (i_d, i_q), (p_ref, v_ref), w = current, references, s[at.SPEED]
    i_fd = s[at.E1Q] + (m.xd - m.xd1) * (m.gd1 * i_d + m.gd2 * (s[at.E1Q] - s[at.E2D]))
    i_1q = s[at.E1D] + (m.xq - m.xq1) * (m.gq2 * (s[at.E1D] - s[at.E2Q]) - m.gq1 * i_q)
    after = m.ks * w - s[at.WASHOUT]
    between = m.lead_a * (after - s[at.LEAD_A]) + s[at.LEAD_A]
    v_s = m.lead_b * (between - s[at.LEAD_B]) + s[at.LEAD_B]
    u = v_ref - v + v_s - m.dc * m.lead * (s[at.FIELD] - s[at.FEEDBACK])
    static = m.gain * (m.lead * (u - s[at.EXCITER]) + s[at.EXCITER])
    drive = m.dc * s[at.EXCITER] + (1.0 - m.dc) * static
    rates[at.DELTA] = m.omega_0 * w
    rates[at.SPEED] = m.inverse_m * (m.reheat * (s[at.GATE] - s[at.TURBINE]) + s[at.TURBINE] - p_e - m.d * w)
    rates[at.E1Q] = m.rate_d1 * (s[at.FIELD] - i_fd)
    rates[at.E1D] = -m.rate_q1 * i_1q
    rates[at.E2D] = m.rate_d2 * (s[at.E1Q] - s[at.E2D] - (m.xd1 - m.xl) * i_d)
    rates[at.E2Q] = m.rate_q2 * (s[at.E1D] - s[at.E2Q] + (m.xq1 - m.xl) * i_q)
    rates[at.EXCITER] = m.rate_x * ((m.dc * m.gain + (1.0 - m.dc)) * u - s[at.EXCITER])
    rates[at.FIELD] = m.rate_f * (drive - m.ke * s[at.FIELD])
    rates[at.FEEDBACK] = m.rate_fb * (s[at.FIELD] - s[at.FEEDBACK])
    rates[at.WASHOUT] = m.rate_w * after
    rates[at.LEAD_A] = m.rate_a * (after - s[at.LEAD_A])
    rates[at.LEAD_B] = m.rate_b * (between - s[at.LEAD_B])
    rates[at.GATE] = m.rate_g * (p_ref - m.droop * w - s[at.GATE])
    rates[at.TURBINE] = m.rate_h * (s[at.GATE] - s[at.TURBINE])


_set_rates = inlined(set_rates)


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
        e1q, e1d, e2d, e2q = x[at.E1Q, i], x[at.E1D, i], x[at.E2D, i], x[at.E2Q, i]
        re, im = v[2 * data[i].port], v[2 * data[i].port + 1]
        sin, cos = np.sin(x[at.DELTA, i] - turn), np.cos(x[at.DELTA, i] - turn)
        v_d, v_q = re * sin - im * cos, re * cos + im * sin
        i_d = (data[i].gd1 * e1q + (1.0 - data[i].gd1) * e2d - v_q) / data[i].x
        i_q = (v_d - data[i].gq1 * e1d - (1.0 - data[i].gq1) * e2q) / data[i].x
        p_e[i] = v_d * i_d + v_q * i_q
        size = np.sqrt(re * re + im * im)
        _set_rates(data[i], x[:, i], (i_d, i_q), size, (p_ref[i], v_ref[i]), p_e[i], rates[:, i])
