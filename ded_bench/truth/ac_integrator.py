"""Classical machines on the full AC network, integrated by an explicit Runge-Kutta method; compiled.

Buses without a load of constant power are eliminated: the voltages v of the others are
v = Z i(v) + W e, with the currents i = conj(s / v) of the loads and the machines' voltages e behind x'd.
At every stage Newton's method solves this with a kept inverse of the Jacobian ("chord"), which is renewed
where it converges slowly. Complex vectors are real ones here: real parts, then imaginary parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled
from ded_bench.truth.integrator import Inputs, Tableau

#: Newton gives up after so many steps.
NEWTON_STEPS = 30
#: The Jacobian is renewed where a step makes the mismatch smaller by less than this factor.
CONTRACTION = 0.02
#: Voltages are solved for to this, pu.
MISMATCH = 1e-13


class AcGrid(NamedTuple):
    """An AC network, reduced to its machines and loads; the slack's machine is the last one.

    Matrices act on rows from the right: (x.real, x.imag) @ matrix.
    """

    emf: Array  # (n_machine,): |E'| behind x'd, pu
    reactive: Array  # (n_load,): injected by the loads, pu
    impedance: Array  # (2 n_load, 2 n_load): Z, voltages from currents of loads
    transfer: Array  # (2 n_machine, 2 n_load): W, voltages from e
    own_current: Array  # (2 n_machine, 2 n_machine): machine currents from e
    load_current: Array  # (2 n_load, 2 n_machine): machine currents from those of loads
    m: Array  # (n_gen,), s² pu/rad
    d: Array  # (n_gen,), s pu/rad


@compiled
def integrate_ac(
    tableau: Tableau,
    grid: AcGrid,
    inputs: Inputs,
    steps: int,
    theta: Array,
    omega: Array,
    voltage: Array,
    power: Array,
) -> int:
    """Integrate from the first point of time to the last.

    Args:
        tableau: the method.
        grid: the network.
        inputs: powers of the generators and active powers of the loads at n points of time.
        steps: steps from one point to the next.
        theta: angles of the generators' E', (n, n_gen), rad; the first row is given, others are computed.
        omega: frequency deviations, (n, n_gen), rad/s; likewise.
        voltage: of the loads, (n, 2 n_load), pu; likewise.
        power: receives the electrical powers of the machines, (n, n_machine), pu.

    Returns:
        The number of points computed: less than n where the network's equations have no solution.
    """
    n: int = len(omega)
    n_gen, n_load, n_stages = omega.shape[1], len(grid.reactive), len(tableau.c)
    h = inputs.dt / steps
    # Voltages at the same stage of the last four steps predict those of the next.
    recent = np.empty((4, n_stages, 2 * n_load))
    recent[:] = voltage[0]
    angle, v, active = np.empty(n_gen), voltage[0].copy(), np.empty(n_load)
    e, source = np.empty(2 * len(grid.emf)), np.empty(2 * n_load)
    i_load, p = np.empty(2 * n_load), np.empty(len(grid.emf))
    angle_rate, speed_rate = np.empty((n_stages, n_gen)), np.empty((n_stages, n_gen))
    start, speed = theta[0].copy(), omega[0].copy()
    inverse = np.empty((2 * n_load, 2 * n_load))
    _invert(grid, inputs.injection[0], v, inverse)
    for k in range(n):
        after = min(k + 1, n - 1)
        for j in range(steps):
            for s in range(n_stages):
                inside = (j + tableau.c[s]) / steps
                for g in range(n_gen):
                    angle[g], angle_rate[s, g] = start[g], speed[g]
                    for r in range(s):
                        angle[g] += h * tableau.a[s, r] * angle_rate[r, g]
                        angle_rate[s, g] += h * tableau.a[s, r] * speed_rate[r, g]
                for i in range(n_load):
                    active[i] = inputs.injection[k, i]
                    active[i] += inside * (inputs.injection[after, i] - inputs.injection[k, i])
                for i in range(2 * n_load):
                    v[i] = 4.0 * (recent[0, s, i] + recent[2, s, i])
                    v[i] -= 6.0 * recent[1, s, i] + recent[3, s, i]
                _machine_voltages(grid, angle, e, source)
                if not _solve_voltages(grid, source, active, inverse, v, i_load):
                    v[:] = recent[0, s]  # a bad guess? from the voltages of the step before, then
                    if not _solve_voltages(grid, source, active, inverse, v, i_load):
                        return k
                _machine_powers(grid, e, i_load, p)
                recent[3, s], recent[2, s], recent[1, s] = recent[2, s], recent[1, s], recent[0, s]
                recent[0, s] = v
                if s == 0 and j == 0:
                    theta[k], omega[k], voltage[k], power[k] = angle, speed, v, p
                    if k == n - 1:
                        return n
                for g in range(n_gen):
                    wanted = inputs.p_gen[k, g] + inside * (inputs.p_gen[after, g] - inputs.p_gen[k, g])
                    speed_rate[s, g] = (wanted - p[g] - grid.d[g] * angle_rate[s, g]) / grid.m[g]
            for s in range(n_stages):
                for g in range(n_gen):
                    start[g] += h * tableau.b[s] * angle_rate[s, g]
                    speed[g] += h * tableau.b[s] * speed_rate[s, g]
    return n


@compiled
def solve_network(grid: AcGrid, angle: Array, active: Array, v: Array, i_load: Array, p: Array) -> bool:
    """Find the voltages of loads at given angles of the generators' E', and what the machines deliver.

    Args:
        grid: the network.
        angle: of the generators' E', (n_gen,), rad.
        active: powers injected by the loads, (n_load,), pu.
        v: voltages of the loads, (2 n_load,), pu; a guess becomes the answer.
        i_load: receives the currents injected by the loads, (2 n_load,), pu.
        p: receives the electrical powers of the machines, (n_machine,), pu.

    Returns:
        Whether there is a solution; LinAlgError where a Jacobian is singular.
    """
    e, source = np.empty(2 * len(grid.emf)), np.empty(len(v))
    inverse = np.empty((len(v), len(v)))
    _machine_voltages(grid, angle, e, source)
    _invert(grid, active, v, inverse)
    if not _solve_voltages(grid, source, active, inverse, v, i_load):
        return False
    _machine_powers(grid, e, i_load, p)
    return True


@compiled
def _machine_voltages(grid: AcGrid, angle: Array, e: Array, source: Array) -> None:
    """Set the machines' e, and the voltages W e that loads without current would see."""
    n, last = len(grid.emf), len(grid.emf) - 1
    for g in range(last):
        e[g], e[n + g] = grid.emf[g] * np.cos(angle[g]), grid.emf[g] * np.sin(angle[g])
    e[last], e[n + last] = grid.emf[last], 0.0
    source[:] = 0.0
    for g in range(2 * n):
        value, row = e[g], grid.transfer[g]
        for i in range(len(source)):
            source[i] += value * row[i]


@compiled
def _machine_powers(grid: AcGrid, e: Array, i_load: Array, p: Array) -> None:
    """Set the electrical powers of the machines, Re(e conj(i))."""
    n = len(p)
    current = np.zeros(2 * n)
    for g in range(2 * n):
        value, row = e[g], grid.own_current[g]
        for i in range(2 * n):
            current[i] += value * row[i]
    for g in range(len(i_load)):
        value, row = i_load[g], grid.load_current[g]
        for i in range(2 * n):
            current[i] += value * row[i]
    for g in range(n):
        p[g] = e[g] * current[g] + e[n + g] * current[n + g]


@compiled
def _solve_voltages(
    grid: AcGrid, source: Array, active: Array, inverse: Array, v: Array, i_load: Array
) -> bool:
    """Find v = Z i(v) + source; i_load receives i(v).

    Returns:
        Whether there is a solution; if there is none, v and i_load mean nothing.
    """
    n = len(active)
    off = np.empty(2 * n)
    last = np.inf
    for _ in range(NEWTON_STEPS):
        for i in range(n):
            real, imaginary = v[i], v[n + i]
            square = real * real + imaginary * imaginary
            i_load[i] = (active[i] * real + grid.reactive[i] * imaginary) / square
            i_load[n + i] = (active[i] * imaginary - grid.reactive[i] * real) / square
        for i in range(2 * n):
            off[i] = v[i] - source[i]
        for j in range(2 * n):
            value, row = i_load[j], grid.impedance[j]
            for i in range(2 * n):
                off[i] -= value * row[i]
        worst = 0.0
        for i in range(2 * n):
            size = abs(off[i])
            if not size < np.inf:  # before max, which passes over what is not a number
                return False
            worst = max(worst, size)
        if worst < MISMATCH:
            return True
        if worst > CONTRACTION * last:
            _invert(grid, active, v, inverse)
        last = worst
        for j in range(2 * n):
            value, row = off[j], inverse[j]
            for i in range(2 * n):
                v[i] -= value * row[i]
    return False


@compiled
def _invert(grid: AcGrid, active: Array, v: Array, inverse: Array) -> None:
    """Set the transposed inverse of I - Z ∂i/∂v; LinAlgError if it is singular."""
    n = len(active)
    jacobian = np.eye(2 * n)
    for i in range(n):
        real, imaginary, p, q = v[i], v[n + i], active[i], grid.reactive[i]
        square = real * real + imaginary * imaginary
        even = (p * (imaginary**2 - real**2) - 2.0 * q * real * imaginary) / square**2
        odd = (q * (real**2 - imaginary**2) - 2.0 * p * real * imaginary) / square**2
        # ∂i/∂v = [[even, odd], [odd, -even]], since conj(s / v) is analytic in conj(v)
        for j in range(2 * n):
            first, second = grid.impedance[i, j], grid.impedance[n + i, j]
            jacobian[i, j] -= even * first + odd * second
            jacobian[n + i, j] -= odd * first - even * second
    inverse[:] = np.linalg.inv(jacobian)
