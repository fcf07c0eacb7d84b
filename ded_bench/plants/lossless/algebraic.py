"""The algebraic equations of the lossless network: angles of load and junction buses; compiled.

Newton's method keeps the factors of the Jacobian ("chord"), and renews them where it converges slowly. The
Jacobian is sparse and symmetric: it is factorised into L D Lᵀ without pivoting, in an order that leaves few
entries (minimum degree; George and Liu, Computer Solution of Large Sparse Positive Definite Systems, 5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ded_bench.problem.case import Array, Indices
from ded_bench.problem.compiled import allocation_free, compiled

#: Newton gives up after so many steps.
NEWTON_STEPS = 30
#: What a step has to leave of the mismatch at most, else the Jacobian is renewed.
CONTRACTION = 0.0001
#: Coefficients of the sine's Taylor series, the last first: within a quarter turn the next is below rounding.
SINE = np.array([(-1) ** k / math.factorial(2 * k + 1) for k in range(9, -1, -1)])
#: Half turns from which on an angle has no sine here: doubles resolve it no more to the mismatch.
MOST_TURNS = 1e4


class Elimination(NamedTuple):
    """In which order rows of a sparse symmetric matrix are eliminated, and which rows each one then meets."""

    order: Indices  # (n,): the rows
    first: Indices  # (n + 1,): where what each meets begins in `met`
    met: Indices  # rows that are eliminated later or not at all


class CompiledGrid(NamedTuple):
    """A lossless network and its machines."""

    lines: Indices  # (n_line, 2): the buses that each joins
    coupling: Array  # (n_line,), pu
    generators: Indices  # (n_gen,): their buses
    algebraic: Indices  # (n_algebraic,): buses whose angles follow from injections, such as loads
    elimination: Elimination  # of the algebraic buses
    slack: int
    m: Array  # (n_gen,), s² pu/rad
    d: Array  # (n_gen,), s pu/rad
    mismatch: float  # algebraic equations are solved to this, pu
    contraction: float  # a step has to leave no more of the mismatch, else the Jacobian is renewed


def elimination_order(joined: Iterable[Sequence[int]], n: int, kept: int = 0) -> Elimination:
    """An order in which each row meets few others.

    Args:
        joined: pairs of rows that have an entry in common.
        n: number of rows.
        kept: so many of the first are not eliminated.
    """
    near: dict[int, set[int]] = {row: set() for row in range(n)}
    for one, other in joined:
        near[one].add(other)
        near[other].add(one)
    left, order, met = set(range(kept, n)), [], []
    while left:
        row = min(left, key=lambda r: (len(near[r]), r))
        left.remove(row)
        order.append(row)
        met.append(sorted(near[row]))
        for other in met[-1]:
            near[other] = (near[other] | near[row]) - {other, row}
    first = np.cumsum([0, *map(len, met)])
    return Elimination(np.array(order, int), first, np.array([r for rows in met for r in rows], int))


@allocation_free
def eliminate(elimination: Elimination, matrix: Array, factor: Array) -> None:
    """Eliminate rows of a symmetric matrix; what is left of the others is the Schur complement.

    Args:
        elimination: which rows, in which order.
        matrix: rows that were eliminated mean nothing afterwards.
        factor: receives D and then the entries of L, (n + n_met,); no numbers if a pivot is zero.
    """
    order, first, met = elimination
    for i in range(len(order)):
        row = order[i]
        pivot = matrix[row, row] if matrix[row, row] != 0.0 else np.nan
        factor[i] = pivot
        for p in range(first[i], first[i + 1]):
            entry = factor[len(order) + p] = matrix[row, met[p]] / pivot
            for q in range(first[i], first[i + 1]):
                matrix[met[p], met[q]] -= entry * matrix[row, met[q]]


@allocation_free
def solve_factorised(elimination: Elimination, factor: Array, x: Array) -> None:
    """Solve equations whose factors are given; x, (n,), is their right side, and becomes the answer."""
    order, first, met = elimination
    n = len(order)
    for i in range(n):
        for p in range(first[i], first[i + 1]):
            x[met[p]] -= factor[n + p] * x[order[i]]
    for i in range(n - 1, -1, -1):
        value = x[order[i]] / factor[i]
        for p in range(first[i], first[i + 1]):
            value -= factor[n + p] * x[met[p]]
        x[order[i]] = value


@compiled
def factorise(grid: CompiledGrid, angle: Array, factor: Array) -> None:
    """Factors of the algebraic buses' Jacobian (`eliminate`)."""
    n = len(grid.algebraic)
    jacobian = np.empty((n, n))
    set_jacobian(grid, angle, jacobian)
    eliminate(grid.elimination, jacobian, factor)


@allocation_free
def solve_algebraic(
    grid: CompiledGrid, wanted: Array, factor: Array, angle: Array, f: Array, work: tuple[Array, Array]
) -> bool:
    """Find the angles of algebraic buses that give the wanted injections; f receives those of all buses.

    `work` has room for as much as algebraic buses, and for as much as lines.

    Returns:
        Whether there is a solution; if there is none, angles and f mean nothing.
    """
    last, (correction, across) = np.inf, work
    for _ in range(NEWTON_STEPS):
        worst = _mismatch(grid, wanted, angle, f, across)
        if worst < grid.mismatch:
            return True
        if not worst < np.inf:
            return False
        if worst > grid.contraction * last:
            factorise(grid, angle, factor)
        last = worst
        for i in range(len(wanted)):
            correction[i] = f[grid.algebraic[i]] - wanted[i]
        solve_factorised(grid.elimination, factor, correction)
        for i in range(len(wanted)):
            angle[grid.algebraic[i]] -= correction[i]
    return False


@compiled
def solve_angles(grid: CompiledGrid, wanted: Array, theta: Array, f: Array) -> bool:
    """Find the angles of algebraic buses that give wanted injections, one instance after another.

    Args:
        grid: the network.
        wanted: injections, (batch, n_algebraic), pu.
        theta: angles of all buses, (batch, n_bus), rad; guesses of the algebraic ones become answers.
        f: receives the injections of all buses, (batch, n_bus), pu.

    Returns:
        Whether there is a solution for all.
    """
    n, n_met = len(grid.algebraic), len(grid.elimination.met)
    factor, work = np.empty(n + n_met), (np.empty(n), np.empty(len(grid.coupling)))
    for b in range(len(theta)):
        factorise(grid, theta[b], factor)
        if not solve_algebraic(grid, wanted[b], factor, theta[b], f[b], work):
            return False
    return True


@allocation_free
def _to_sines(angles: Array) -> None:
    """Replace angles, (n,), rad, by their sines: `np.sin` is not vectorised, and takes four times as long."""
    for i in range(len(angles)):
        half_turns = np.rint(angles[i] * (1.0 / np.pi))
        odd = half_turns - 2.0 * np.floor(0.5 * half_turns)
        x = (angles[i] - np.pi * half_turns) * (1.0 - 2.0 * odd) if abs(half_turns) < MOST_TURNS else np.nan
        square, series = x * x, 0.0
        for k in range(len(SINE)):
            series = series * square + SINE[k]
        angles[i] = x * series


@allocation_free
def _mismatch(grid: CompiledGrid, wanted: Array, angle: Array, f: Array, across: Array) -> float:
    """Largest difference of algebraic buses' injections from those wanted, pu; infinite if one is no number.

    f receives the injections of all buses; `across` is to work on, (n_line,).
    """
    for i in range(len(f)):
        f[i] = 0.0
    for i in range(len(across)):
        across[i] = angle[grid.lines[i, 0]] - angle[grid.lines[i, 1]]
    _to_sines(across)
    for i in range(len(across)):
        flow = grid.coupling[i] * across[i]
        f[grid.lines[i, 0]] += flow
        f[grid.lines[i, 1]] -= flow
    worst = 0.0
    for i in range(len(wanted)):
        off = abs(f[grid.algebraic[i]] - wanted[i])
        if not off < np.inf:  # before max, which passes over what is not a number
            return np.inf
        worst = max(worst, off)
    return worst


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
