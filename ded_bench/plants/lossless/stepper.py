"""The index-1 swing DAE, integrated with steps of fixed length; compiled.

Steps are those of an explicit Runge-Kutta method, whatever tableau is given. Where powers and loads have been
linear for long enough, a multistep method may follow, which needs two evaluations a step: Adams's predictor
and corrector of order 8. Where both differ by more than is left to an exact answer, the step is one of
Runge-Kutta's.

At every evaluation the angles of load and junction buses are solved for. Newton's method keeps the inverse of
the Jacobian ("chord"), and renews it where it converges slowly.
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

    order: int
    a: Array  # (s, s), strictly lower triangular
    b: Array  # (s,)
    c: Array  # (s,)


#: Dormand and Prince's method of order 8 (Hairer, Norsett and Wanner, Solving Ordinary Differential
#: Equations I, II.5), with SciPy's coefficients.
DORMAND_PRINCE_8 = Tableau(8, DOP853.A.copy(), DOP853.B.copy(), DOP853.C.copy())
#: Kutta's method of order 4 (ibid., II.1).
KUTTA_4 = Tableau(
    order=4,
    a=np.diag([0.5, 0.5, 1.0], -1),
    b=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
    c=np.array([0.0, 0.5, 0.5, 1.0]),
)
#: Adams's methods of order 8 (ibid., III.1): the predictor weighs the last derivatives, the newest first; the
#: corrector has the predicted one before them.
BASHFORTH = np.array([434241, -1152169, 2183877, -2664477, 2102243, -1041723, 295767, -36799]) / 120960
MOULTON = np.array([36799, 139849, -121797, 123133, -88547, 41499, -11351, 1375]) / 120960
#: Largest difference of predicted and corrected angles, rad, and frequencies, rad/s, of an Adams step: its
#: error is a thirtieth of that.
ADAMS_TOLERANCE = 3e-10
#: What powers and loads of one step may differ from those of the step before and still be linear, pu.
LINEAR = 1e-12


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
    ahead: Array  # the algebraic angles where the next step begins, nearly, (n_algebraic,), rad
    past: Array  # derivatives of angles and frequencies at the last steps, newest first, (8, 2, n_gen)
    counts: Indices  # steps that powers and loads have been linear for; Adams steps since another one; (2,)
    slope: Array  # change of powers and injections in the last interval, (n_gen + n_algebraic,), pu


@compiled
def carried_from(tableau: Tableau, grid: CompiledGrid, theta: Array) -> Carried:
    """What a state without a past has, at angles (n_bus,); LinAlgError if the Jacobian is singular."""
    n, n_gen = len(grid.algebraic), len(grid.generators)
    carried = Carried(
        recent=np.empty((4, len(tableau.c), n)),
        inverse=np.empty((n, n)),
        ahead=np.empty(n),
        past=np.zeros((len(BASHFORTH), 2, n_gen)),
        counts=np.zeros(2, np.int_),
        slope=np.zeros(n_gen + n),
    )
    for i in range(n):
        carried.recent[:, :, i] = carried.ahead[i] = theta[grid.algebraic[i]]
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
        tableau: the Runge-Kutta method; that of order 8 is followed by Adams's.
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
    n_gen, n_bus = omega.shape[1], theta.shape[1]
    n_stages = len(tableau.c)
    h = inputs.dt / steps
    angle, f = theta[0].copy(), np.empty(n_bus)
    rates = np.empty((n_stages, 2, n_gen))
    state, stage, predicted = np.empty((2, n_gen)), np.empty((2, n_gen)), np.empty((2, n_gen))
    for g in range(n_gen):
        state[0, g], state[1, g] = angle[grid.generators[g]], omega[0, g]
    for k in range(n):
        if k == n - 1:  # the next piece does this point once more
            carried = Carried(
                carried.recent.copy(),
                carried.inverse.copy(),
                carried.ahead,
                carried.past,
                carried.counts,
                carried.slope,
            )
        elif _bends(inputs, k, carried.slope):
            carried.counts[0] = 0
        for j in range(steps):
            angle[grid.algebraic] = carried.ahead
            if not _evaluate(grid, inputs, k, j / steps, carried, 0, state, angle, f, rates[0]):
                return k
            if j == 0:
                theta[k], omega[k], p_slack[k] = angle, state[1], f[grid.slack]
                if k == n - 1:
                    return n
            if tableau.order == len(BASHFORTH) and _adams(
                grid, inputs, k, j, steps, carried, state, predicted, angle, f, rates
            ):
                continue
            if carried.counts[1] > 0:  # of stages that Adams steps left out there is no past
                carried.recent[:, 1:], carried.counts[1] = carried.recent[0, 0], 0
            for s in range(1, n_stages):
                stage[:] = state
                for r in range(s):
                    for q in range(2):
                        for g in range(n_gen):
                            stage[q, g] += h * tableau.a[s, r] * rates[r, q, g]
                _extrapolate(grid, carried.recent[:, s], angle)
                inside = (j + tableau.c[s]) / steps
                if not _evaluate(grid, inputs, k, inside, carried, s, stage, angle, f, rates[s]):
                    return k
            for s in range(n_stages):
                for q in range(2):
                    for g in range(n_gen):
                        state[q, g] += h * tableau.b[s] * rates[s, q, g]
            _extrapolate(grid, carried.recent[:, 0], angle)
            carried.ahead[:] = angle[grid.algebraic]
    return n


@compiled
def _adams(
    grid: CompiledGrid,
    inputs: GridInputs,
    k: int,
    j: int,
    steps: int,
    carried: Carried,
    state: Array,
    predicted: Array,
    angle: Array,
    f: Array,
    rates: Array,
) -> bool:
    """Take a step of Adams's methods, if powers and loads have been linear for long enough.

    Returns:
        Whether it was exact enough; else `state` is as before.
    """
    past, h = carried.past, inputs.dt / steps
    for i in range(len(past) - 1, 0, -1):
        past[i] = past[i - 1]
    past[0] = rates[0]
    carried.counts[0] += 1
    if carried.counts[0] < len(past):
        return False
    predicted[:] = state
    for i in range(len(past)):
        for q in range(2):
            for g in range(state.shape[1]):
                predicted[q, g] += h * BASHFORTH[i] * past[i, q, g]
    _extrapolate(grid, carried.recent[:, 0], angle)
    if not _evaluate(grid, inputs, k, (j + 1) / steps, carried, -1, predicted, angle, f, rates[1]):
        return False
    off = 0.0
    for q in range(2):
        for g in range(state.shape[1]):
            change = MOULTON[0] * rates[1, q, g]
            for i in range(1, len(MOULTON)):
                change += MOULTON[i] * past[i - 1, q, g]
            corrected = state[q, g] + h * change
            off = max(off, abs(corrected - predicted[q, g]))
            predicted[q, g] = corrected
    if not off < ADAMS_TOLERANCE:
        return False
    state[:] = predicted
    carried.counts[1] += 1
    carried.ahead[:] = angle[grid.algebraic]
    return True


@inlined
def _bends(inputs: GridInputs, k: int, slope: Array) -> bool:
    """Whether powers or loads change otherwise after a point than before it; `slope` becomes their change."""
    off, n_gen = 0.0, inputs.p_gen.shape[1]
    for g in range(n_gen):
        change = inputs.p_gen[k + 1, g] - inputs.p_gen[k, g]
        off, slope[g] = max(off, abs(change - slope[g])), change
    for i in range(inputs.injection.shape[1]):
        change = inputs.injection[k + 1, i] - inputs.injection[k, i]
        off, slope[n_gen + i] = max(off, abs(change - slope[n_gen + i])), change
    return off > LINEAR


@inlined
def _extrapolate(grid: CompiledGrid, recent: Array, angle: Array) -> None:
    """Guess the algebraic angles of the next step from those of the last four, (4, n_algebraic)."""
    for i in range(recent.shape[1]):
        ahead = 4.0 * (recent[0, i] + recent[2, i])
        ahead -= 6.0 * recent[1, i] + recent[3, i]
        angle[grid.algebraic[i]] = ahead


@compiled
def _evaluate(
    grid: CompiledGrid,
    inputs: GridInputs,
    k: int,
    inside: float,
    carried: Carried,
    s: int,
    state: Array,
    angle: Array,
    f: Array,
    rates: Array,
) -> bool:
    """Derivatives of angles and frequencies, (2, n_gen) like the state, at a part of the interval after k.

    Args:
        s: the stage; the algebraic angles become its latest. -1: none.
        angle: guesses of the algebraic ones become answers.
        f: receives the injections of all buses.
        rates: receives the derivatives.

    Returns:
        Whether the algebraic equations have a solution.
    """
    n_gen, n_algebraic, after = state.shape[1], len(grid.algebraic), min(k + 1, len(inputs.p_gen) - 1)
    wanted = np.empty(n_algebraic)
    for g in range(n_gen):
        angle[grid.generators[g]] = state[0, g]
    for i in range(n_algebraic):
        wanted[i] = inputs.injection[k, i]
        wanted[i] += inside * (inputs.injection[after, i] - inputs.injection[k, i])
    recent = carried.recent[:, max(s, 0)]
    if not solve_algebraic(grid, wanted, carried.inverse, angle, f):
        for i in range(n_algebraic):  # a bad guess? from the angles of the step before, then
            angle[grid.algebraic[i]] = recent[0, i]
        if not solve_algebraic(grid, wanted, carried.inverse, angle, f):
            return False
    if s >= 0:
        for i in range(n_algebraic):
            recent[3, i], recent[2, i], recent[1, i] = recent[2, i], recent[1, i], recent[0, i]
            recent[0, i] = angle[grid.algebraic[i]]
    for g in range(n_gen):
        power = inputs.p_gen[k, g] + inside * (inputs.p_gen[after, g] - inputs.p_gen[k, g])
        force = power - f[grid.generators[g]] - grid.d[g] * state[1, g]
        rates[0, g], rates[1, g] = state[1, g], force / grid.m[g]
    return True


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
