"""The algebraic equations of the lossless network: angles of load and junction buses; compiled.

Newton's method keeps the inverse of the Jacobian ("chord"), and renews it where it converges slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled, inlined

Indices = NDArray[np.int_]

#: Newton gives up after so many steps.
NEWTON_STEPS = 30
#: What a step has to leave of the mismatch at most, else the Jacobian is renewed.
CONTRACTION = 0.02


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
            invert(grid, angle, inverse)
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
def invert(grid: CompiledGrid, angle: Array, inverse: Array) -> None:
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
