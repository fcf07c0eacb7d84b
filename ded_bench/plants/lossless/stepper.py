"""The index-1 swing DAE, integrated by an explicit Runge-Kutta method with steps of fixed length; compiled.

The method is whatever tableau is given. At every stage the angles of load and junction buses are solved for.
Newton's method keeps the inverse of the Jacobian ("chord"), and renews it where it converges slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled, inlined

Indices = NDArray[np.int_]

#: Newton gives up after so many steps.
NEWTON_STEPS = 30
#: What a step has to leave of the mismatch at most, else the Jacobian is renewed.
CONTRACTION = 0.02


class Tableau(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method with s stages."""

    a: Array  # (s, s), strictly lower triangular
    b: Array  # (s,)
    c: Array  # (s,)


#: Dormand and Prince's method of order 8 (Hairer, Norsett and Wanner, Solving Ordinary Differential
#: Equations I, II.5), with SciPy's coefficients.
DORMAND_PRINCE_8 = Tableau(DOP853.A.copy(), DOP853.B.copy(), DOP853.C.copy())
#: Kutta's method of order 4 (ibid., II.1).
KUTTA_4 = Tableau(
    a=np.diag([0.5, 0.5, 1.0], -1), b=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0, c=np.array([0.0, 0.5, 0.5, 1.0])
)


class CompiledGrid(NamedTuple):
    """A lossless network and its machines."""

    lines: Indices  # (n_line, 2): the buses that each joins
    coupling: Array  # (n_line,), pu
    generators: Indices  # (n_gen,): their buses
    algebraic: Indices  # (n_algebraic,): buses whose angles follow from injections, such as loads
    slack: int
    m: Array  # (n_gen,), s² pu/rad
    d: Array  # (n_gen,), s pu/rad
    mismatch: float  # algebraic equations are solved to this, pu


class GridInputs(NamedTuple):
    """What drives the grid at the points of time, linear between them."""

    p_gen: Array  # (n, n_gen), pu
    injection: Array  # (n, n_algebraic), pu
    dt: float  # s


class Carried(NamedTuple):
    """What goes on from piece to piece, so that pieces are the whole to the last bit."""

    recent: Array  # angles at each stage of the last four steps, (4, n_stages, n_algebraic), rad
    inverse: Array  # of the Jacobian, (n_algebraic, n_algebraic), rad/pu


@compiled
def carried_from(tableau: Tableau, grid: CompiledGrid, theta: Array) -> Carried:
    """What a state without a past has, at angles (n_bus,); LinAlgError if the Jacobian is singular."""
    n = len(grid.algebraic)
    carried = Carried(np.empty((4, len(tableau.c), n)), np.empty((n, n)))
    for i in range(n):
        carried.recent[:, :, i] = theta[grid.algebraic[i]]
    _invert(grid, theta, carried.inverse)
    return carried


@compiled
def integrate(
    tableau: Tableau,
    grid: CompiledGrid,
    inputs: GridInputs,
    steps: int,
    carried: Carried,
    theta: Array,
    omega: Array,
    p_slack: Array,
) -> int:
    """Integrate from the first point of time to the last.

    Args:
        tableau: the method.
        grid: the network.
        inputs: powers at n points of time.
        steps: steps from one point to the next.
        carried: from the piece before; becomes what the next one needs.
        theta: angles of all buses, (n, n_bus), rad; the first row is given and the others are computed.
        omega: frequency deviations, (n, n_gen), rad/s; likewise.
        p_slack: receives the slack's power, (n,), pu.

    Returns:
        The number of points computed: less than n where the algebraic equations have no solution.
    """
    n: int = len(omega)
    n_gen, n_bus, n_algebraic = omega.shape[1], theta.shape[1], len(grid.algebraic)
    n_stages = len(tableau.c)
    h = inputs.dt / steps
    # Angles at the same stage of the last four steps predict those of the next.
    recent, inverse = carried.recent, carried.inverse
    angle, f, wanted = theta[0].copy(), np.empty(n_bus), np.empty(n_algebraic)
    angle_rate, speed_rate = np.empty((n_stages, n_gen)), np.empty((n_stages, n_gen))
    start, speed = np.empty(n_gen), omega[0].copy()
    for g in range(n_gen):
        start[g] = angle[grid.generators[g]]
    for k in range(n):
        if k == n - 1:  # the next piece does this point once more
            recent, inverse = recent.copy(), inverse.copy()
        for j in range(steps):
            for s in range(n_stages):
                inside = (j + tableau.c[s]) / steps
                for g in range(n_gen):
                    first, second = start[g], speed[g]
                    for r in range(s):
                        first += h * tableau.a[s, r] * angle_rate[r, g]
                        second += h * tableau.a[s, r] * speed_rate[r, g]
                    angle[grid.generators[g]] = first
                    angle_rate[s, g] = second
                after = min(k + 1, n - 1)
                for i in range(n_algebraic):
                    wanted[i] = inputs.injection[k, i]
                    wanted[i] += inside * (inputs.injection[after, i] - inputs.injection[k, i])
                    ahead = 4.0 * (recent[0, s, i] + recent[2, s, i])
                    ahead -= 6.0 * recent[1, s, i] + recent[3, s, i]
                    angle[grid.algebraic[i]] = ahead
                solved = solve_algebraic(grid, wanted, inverse, angle, f)
                if not solved:  # a bad guess? from the angles of the step before, then
                    for i in range(n_algebraic):
                        angle[grid.algebraic[i]] = recent[0, s, i]
                    solved = solve_algebraic(grid, wanted, inverse, angle, f)
                if not solved:
                    return k
                for i in range(n_algebraic):
                    recent[3, s, i], recent[2, s, i] = recent[2, s, i], recent[1, s, i]
                    recent[1, s, i] = recent[0, s, i]
                    recent[0, s, i] = angle[grid.algebraic[i]]
                if s == 0 and j == 0:
                    theta[k], omega[k], p_slack[k] = angle, speed, f[grid.slack]
                    if k == n - 1:
                        return n
                for g in range(n_gen):
                    power = inputs.p_gen[k, g] + inside * (inputs.p_gen[after, g] - inputs.p_gen[k, g])
                    force = power - f[grid.generators[g]] - grid.d[g] * angle_rate[s, g]
                    speed_rate[s, g] = force / grid.m[g]
            for s in range(n_stages):
                for g in range(n_gen):
                    start[g] += h * tableau.b[s] * angle_rate[s, g]
                    speed[g] += h * tableau.b[s] * speed_rate[s, g]
    return n


@compiled
def solve_algebraic(
    grid: CompiledGrid,
    wanted: Array,
    inverse: Array,
    angle: Array,
    f: Array,
    contraction: float = CONTRACTION,
) -> bool:
    """Find the angles of algebraic buses that give the wanted injections; f receives those of all buses.

    The inverse of the Jacobian is renewed where a step makes the mismatch smaller by less than `contraction`.

    Returns:
        Whether there is a solution; if there is none, angles and f mean nothing.
    """
    n = len(wanted)
    correction = np.empty(n)
    last = np.inf
    for _ in range(NEWTON_STEPS):
        worst = _mismatch(grid, wanted, angle, f)
        if worst < grid.mismatch:
            return True
        if not worst < np.inf:
            return False
        if worst > contraction * last:
            _invert(grid, angle, inverse)
        last = worst
        correction[:] = 0.0
        for i in range(n):  # the inverse is symmetric: row after row is the fastest way through it
            off, row = f[grid.algebraic[i]] - wanted[i], inverse[i]
            for j in range(n):
                correction[j] += off * row[j]
        for i in range(n):
            angle[grid.algebraic[i]] -= correction[i]
    return False


@compiled
def solve_angles(grid: CompiledGrid, wanted: Array, theta: Array, f: Array) -> bool:
    """Find the angles of algebraic buses that give wanted injections, one instance after another.

    Newton's method, whose equations are solved anew in every step.

    Args:
        grid: the network.
        wanted: injections, (batch, n_algebraic), pu.
        theta: angles of all buses, (batch, n_bus), rad; guesses of the algebraic ones become answers.
        f: receives the injections of all buses, (batch, n_bus), pu.

    Returns:
        Whether there is a solution for all; LinAlgError where a Jacobian is singular.
    """
    n = wanted.shape[1]
    jacobian, off = np.empty((n, n)), np.empty(n)
    for b in range(len(theta)):
        solved = False
        for _ in range(NEWTON_STEPS):
            worst = _mismatch(grid, wanted[b], theta[b], f[b])
            solved = worst < grid.mismatch
            if solved or not worst < np.inf:
                break
            set_jacobian(grid, theta[b], jacobian)
            for i in range(n):
                off[i] = f[b, grid.algebraic[i]] - wanted[b, i]
            step = np.linalg.solve(jacobian, off)
            for i in range(n):
                theta[b, grid.algebraic[i]] -= step[i]
        if not solved:
            return False
    return True


@inlined
def _mismatch(grid: CompiledGrid, wanted: Array, angle: Array, f: Array) -> float:
    """Largest difference of algebraic buses' injections from those wanted, pu; infinite if one is no number.

    f receives the injections of all buses.
    """
    f[:] = 0.0
    for i in range(len(grid.coupling)):
        near, far = grid.lines[i, 0], grid.lines[i, 1]
        flow = grid.coupling[i] * np.sin(angle[near] - angle[far])
        f[near] += flow
        f[far] -= flow
    worst = 0.0
    for i in range(len(wanted)):
        off = abs(f[grid.algebraic[i]] - wanted[i])
        if not off < np.inf:  # before max, which passes over what is not a number
            return np.inf
        worst = max(worst, off)
    return worst


@compiled
def _invert(grid: CompiledGrid, angle: Array, inverse: Array) -> None:
    """Set the inverse of the algebraic buses' Jacobian; LinAlgError if it is singular."""
    set_jacobian(grid, angle, inverse)
    inverse[:] = np.linalg.inv(inverse)


@compiled
def set_jacobian(grid: CompiledGrid, angle: Array, jacobian: Array) -> None:
    """Set ∂f/∂θ of the algebraic buses, (n_algebraic, n_algebraic), pu/rad."""
    place = np.full(len(angle), -1)
    for i in range(len(grid.algebraic)):
        place[grid.algebraic[i]] = i
    jacobian[:] = 0.0
    for i in range(len(grid.coupling)):
        near, far = place[grid.lines[i, 0]], place[grid.lines[i, 1]]
        slope = grid.coupling[i] * np.cos(angle[grid.lines[i, 0]] - angle[grid.lines[i, 1]])
        if near >= 0:
            jacobian[near, near] += slope
        if far >= 0:
            jacobian[far, far] += slope
        if near >= 0 and far >= 0:
            jacobian[near, far] -= slope
            jacobian[far, near] -= slope
