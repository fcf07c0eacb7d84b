"""The index-1 swing DAE, integrated with steps of fixed length; compiled.

Steps are those of an explicit Runge-Kutta method of order 5. Where powers and loads have been linear for six
steps, it is followed by Adams's predictor and corrector of order 6, which need two evaluations a step. Where
these two differ too much, a Runge-Kutta step is taken.

At every evaluation the angles of load and junction buses are solved for (`algebraic`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.plants.lossless.algebraic import CompiledGrid, factorise, solve_algebraic
from ded_bench.problem.case import Array, Indices
from ded_bench.problem.compiled import allocation_free, copy_row

#: Dormand and Prince's method of order 5 (Hairer, Norsett, Wanner: Solving ODEs I, II.5); SciPy loads slowly.
STAGES = np.zeros((6, 5))
STAGES[1, 0], STAGES[2, :2], STAGES[3, :3] = 1 / 5, (3 / 40, 9 / 40), (44 / 45, -56 / 15, 32 / 9)
STAGES[4, :4] = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
STAGES[5] = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
WEIGHTS = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])
NODES = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1])
#: Adams's methods of order 6 (ibid., III.1): the predictor weighs the last derivatives, the newest first; the
#: corrector has the predicted one before them.
BASHFORTH = np.array([4277, -7923, 9982, -7298, 2877, -475]) / 1440
MOULTON = np.array([475, 1427, -798, 482, -173, 27]) / 1440
#: Steps whose algebraic angles a guess of others goes through.
RECENT = 5
#: Largest difference of predicted and corrected angles, rad, and frequencies, rad/s, of an Adams step: its
#: error is a thirtieth of that.
ADAMS_TOLERANCE = 3e-10
#: What powers and loads of one step may differ from those of the step before and still be linear, pu.
LINEAR = 1e-12


class GridInputs(NamedTuple):
    """What drives the grid at the points of time, linear between them."""

    p_gen: Array  # (n, n_gen), pu
    injection: Array  # (n, n_algebraic), pu
    dt: float  # s
    steps: int  # of the integrator, from one point to the next


class GridStates(NamedTuple):
    """At the points of time; the first angles and frequencies are given, all else is computed."""

    theta: Array  # of all buses, (n, n_bus), rad
    omega: Array  # frequency deviations, (n, n_gen), rad/s
    p_slack: Array  # (n,), pu


class Carried(NamedTuple):
    """What goes on from piece to piece, so that pieces are the whole to the last bit."""

    recent: Array  # algebraic angles at the last steps, newest first, (RECENT, n_algebraic), rad
    factor: Array  # of the Jacobian of the algebraic equations, (n_factor,), see `eliminate`
    ahead: Array  # the algebraic angles where the next step begins, nearly, (n_algebraic,), rad
    past: Array  # derivatives of angles and frequencies at the last steps, newest first, (6, 2 n_gen)
    linear: Indices  # steps that powers and loads have been linear for, (1,)
    slope: Array  # change of powers and injections in the last interval, (n_gen + n_algebraic,), pu


class Work(NamedTuple):
    """Of one step."""

    state: Array  # angles and frequencies of the generators where it begins, (2 n_gen,), rad and rad/s
    stage: Array  # at one of its stages, likewise
    rates: Array  # their derivatives at all of them, (n_stages, 2 n_gen)
    angle: Array  # of all buses, (n_bus,), rad
    f: Array  # injections of all buses, (n_bus,), pu
    wanted: Array  # injections of the algebraic buses, (n_algebraic,), pu
    newton: tuple[Array, Array]  # see `solve_algebraic`
    last: Carried  # as carried, but for angles and factors of its own, which the last point may change


def carried_from(grid: CompiledGrid, theta: Array) -> Carried:
    """What a state without a past has, at angles (n_bus,)."""
    n, n_gen = len(grid.algebraic), len(grid.generators)
    carried = Carried(
        recent=np.empty((RECENT, n)),
        factor=np.empty(n + len(grid.elimination.met)),
        ahead=np.empty(n),
        past=np.zeros((len(BASHFORTH), 2 * n_gen)),
        linear=np.zeros(1, np.int_),
        slope=np.zeros(n_gen + n),
    )
    factorise(grid, theta, carried.factor)
    carried.recent[:] = carried.ahead[:] = theta[grid.algebraic]
    return carried


def work_of(grid: CompiledGrid, theta: Array, carried: Carried) -> Work:
    """Arrays to work on, at angles (n_bus,)."""
    n, n_state = len(grid.algebraic), 2 * len(grid.generators)
    step = np.empty(n_state), np.empty(n_state), np.empty((len(NODES), n_state))
    newton = np.empty(n), np.empty(len(grid.coupling))
    last = carried._replace(recent=carried.recent.copy(), factor=carried.factor.copy())
    return Work(*step, theta.copy(), np.empty(len(theta)), np.empty(n), newton, last)


@allocation_free
def integrate(grid: CompiledGrid, inputs: GridInputs, carried: Carried, work: Work, found: GridStates) -> int:
    """Integrate from the first point of time to the last.

    Args:
        grid: the network.
        inputs: powers at n points of time.
        carried: from the piece before; becomes what the next one needs.
        work: of the first point's angles, and of what is carried.
        found: receives what happens.

    Returns:
        The number of points computed: less than n where the algebraic equations have no solution.
    """
    n, h, state, angle = len(found.omega), inputs.dt / inputs.steps, work.state, work.angle
    n_gen = len(grid.generators)
    for g in range(n_gen):
        state[g], state[n_gen + g] = angle[grid.generators[g]], found.omega[0, g]
    for k in range(n):
        if k == n - 1:  # the next piece does this point once more
            copy_row(carried.factor, work.last.factor)
            for i in range(len(carried.recent)):
                copy_row(carried.recent[i], work.last.recent[i])
            carried = work.last
        elif _bends(inputs, k, carried.slope):
            carried.linear[0] = 0
        for j in range(inputs.steps):
            for i in range(len(carried.ahead)):
                angle[grid.algebraic[i]] = carried.ahead[i]
            if not _evaluate(grid, inputs, (k, j / inputs.steps), carried, 0, state, work):
                return k
            if j == 0:
                copy_row(angle, found.theta[k])
                copy_row(state[n_gen:], found.omega[k])
                found.p_slack[k] = work.f[grid.slack]
                if k == n - 1:
                    return n
            done = _adams(grid, inputs, (k, (j + 1) / inputs.steps), h, carried, work)
            if not (done or _runge_kutta(grid, inputs, (k, j), h, carried, work)):
                return k
            for i in range(len(carried.ahead)):  # near these the next step begins
                carried.ahead[i] = angle[grid.algebraic[i]]
    return n


@allocation_free
def _runge_kutta(
    grid: CompiledGrid, inputs: GridInputs, begin: tuple[int, int], h: float, carried: Carried, work: Work
) -> bool:
    """Take step j after point k, (k, j), whose first derivatives are known; whether there is a solution."""
    (k, j), state, stage, rates = begin, work.state, work.stage, work.rates
    for s in range(1, len(NODES)):
        copy_row(state, stage)
        for r in range(s):
            for i in range(len(state)):
                stage[i] += h * STAGES[s, r] * rates[r, i]
        _extrapolate(grid, carried.recent, NODES[s], work.angle)
        if not _evaluate(grid, inputs, (k, (j + NODES[s]) / inputs.steps), carried, s, stage, work):
            return False
    for s in range(len(NODES)):
        for i in range(len(state)):
            state[i] += h * WEIGHTS[s] * rates[s, i]
    _extrapolate(grid, carried.recent, 1.0, work.angle)
    return True


@allocation_free
def _adams(
    grid: CompiledGrid, inputs: GridInputs, end: tuple[int, float], h: float, carried: Carried, work: Work
) -> bool:
    """Take a step of Adams's methods, if powers and loads have been linear for long enough.

    Args:
        grid: the network.
        inputs: what drives it.
        end: of the step, see `_evaluate`.
        h: its length, s.
        carried: receives the derivatives at its beginning.
        work: with these; the state becomes that of the end, if the step is exact enough.

    Returns:
        Whether it is.
    """
    past, predicted, rates = carried.past, work.stage, work.rates[-1]
    for j in range(len(past) - 1, 0, -1):
        copy_row(past[j - 1], past[j])
    copy_row(work.rates[0], past[0])
    copy_row(work.state, predicted)
    carried.linear[0] += 1
    if carried.linear[0] < len(past):
        return False
    for j in range(len(past)):
        for i in range(len(predicted)):
            predicted[i] += h * BASHFORTH[j] * past[j, i]
    _extrapolate(grid, carried.recent, 1.0, work.angle)
    if not _evaluate(grid, inputs, end, carried, -1, predicted, work):
        return False
    off = 0.0
    for i in range(len(predicted)):
        mean = MOULTON[0] * rates[i]
        for j in range(1, len(MOULTON)):
            mean += MOULTON[j] * past[j - 1, i]
        corrected = work.state[i] + h * mean
        off = max(off, abs(corrected - predicted[i]))
        predicted[i] = corrected
    if not off < max(ADAMS_TOLERANCE, 3.0 * grid.mismatch):
        return False
    copy_row(predicted, work.state)
    return True


@allocation_free
def _bends(inputs: GridInputs, k: int, slope: Array) -> bool:
    """Whether powers or loads change otherwise after a point than before it; `slope` becomes their change."""
    n_gen, bend = inputs.p_gen.shape[1], 0.0
    for i in range(len(slope)):
        before = slope[i]
        if i < n_gen:
            slope[i] = inputs.p_gen[k + 1, i] - inputs.p_gen[k, i]
        else:
            slope[i] = inputs.injection[k + 1, i - n_gen] - inputs.injection[k, i - n_gen]
        bend = max(bend, abs(slope[i] - before))
    return bend > LINEAR


@allocation_free
def _extrapolate(grid: CompiledGrid, recent: Array, ahead: float, angle: Array) -> None:
    """Guess algebraic angles some steps ahead of the newest by Lagrange's polynomial through the recent."""
    for i in range(recent.shape[1]):
        angle[grid.algebraic[i]] = 0.0
    for j in range(len(recent)):
        weight = 1.0
        for m in range(len(recent)):
            if m != j:
                weight *= (ahead + m) / (m - j)
        for i in range(recent.shape[1]):
            angle[grid.algebraic[i]] += weight * recent[j, i]


@allocation_free
def _evaluate(
    grid: CompiledGrid,
    inputs: GridInputs,
    moment: tuple[int, float],
    carried: Carried,
    s: int,
    state: Array,
    work: Work,
) -> bool:
    """Derivatives of a state, (2 n_gen,).

    Args:
        grid: the network.
        inputs: what drives it.
        moment: a point of time, and the part of the interval after it that has gone by.
        carried: gives the factors, and receives the algebraic angles where a step begins.
        s: the stage whose derivatives they are; -1: no stage.
        state: where.
        work: guesses of algebraic angles become answers; receives injections and derivatives.

    Returns:
        Whether the algebraic equations have a solution.
    """
    (k, inside), angle = moment, work.angle
    n_gen, n_algebraic, after = len(grid.generators), len(grid.algebraic), min(k + 1, len(inputs.p_gen) - 1)
    recent, wanted, newton = carried.recent, work.wanted, work.newton
    for g in range(n_gen):
        angle[grid.generators[g]] = state[g]
    for i in range(n_algebraic):
        wanted[i] = inputs.injection[k, i]
        wanted[i] += inside * (inputs.injection[after, i] - inputs.injection[k, i])
    solved = solve_algebraic(grid, wanted, carried.factor, angle, work.f, newton)
    if not solved:  # a bad guess? from the angles of the step before, then
        for i in range(n_algebraic):
            angle[grid.algebraic[i]] = recent[0, i]
        solved = solve_algebraic(grid, wanted, carried.factor, angle, work.f, newton)
    if not solved:
        return False
    if s == 0:
        for i in range(n_algebraic):
            for j in range(len(recent) - 1, 0, -1):
                recent[j, i] = recent[j - 1, i]
            recent[0, i] = angle[grid.algebraic[i]]
    for g in range(n_gen):
        power = inputs.p_gen[k, g] + inside * (inputs.p_gen[after, g] - inputs.p_gen[k, g])
        force = power - work.f[grid.generators[g]] - grid.d[g] * state[n_gen + g]
        work.rates[s, g], work.rates[s, n_gen + g] = state[n_gen + g], force / grid.m[g]
    return True
