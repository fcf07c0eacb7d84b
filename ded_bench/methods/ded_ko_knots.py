"""DED-KO on few knots: the LP over all points, restricted to schedules that are linear between knots.

On the condensed model (ω, P_s) at every point are affine in the knots, so the knots are the only
variables. Few of the many frequency limits bind and P_s changes sign at few points; what is needed
of both is added as the solution asks for it, until all points are right.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.koopman.model import Koopman, hat_functions
from ded_bench.koopman.surrogates import find_model
from ded_bench.methods.artifact import Artifact, model_artifact
from ded_bench.methods.ded_ko import check_step
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import GrowingProgram
from ded_bench.solvers.status import Status
from ded_bench.truth.network import Network

Indices = NDArray[np.intp]

SETTINGS = {"default": "highs"}

#: Knots lie at j * horizon / (N_KNOTS - 1).
N_KNOTS = 50
#: The slack's cost Σ|P_s| is a sum over this many pieces of the horizon, each with a variable above it.
#: More pieces take fewer rounds, but each round longer.
N_PIECES = 70
#: What the LP may leave open at the end: frequency in rad/s (1.6e-8 Hz; HiGHS leaves as much in each
#: row), cost as a fraction of all (a hundredth of the smallest gap that tables show).
OMEGA_TOLERANCE = 1e-7
COST_TOLERANCE = 1e-6
#: With a limit broken somewhere, every peak of |ω| above this part of the bound gets its row.
NEAR = 0.9
MAX_ROUNDS = 100
#: What a schedule does at all points is computed in this many blocks of time. Within one it depends on
#: few numbers: the state at its start and the knots nearby.
N_BLOCKS = 16


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The Koopman model that `prepare` would use."""
    return (model_artifact(case, settings),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances on the Koopman model that the settings name."""
    return prepare_with(case, find_model(case, settings.model, settings.search), regime, settings)


def prepare_with(case: Case, koopman: Koopman, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; one condensed model per process serves them all."""
    case.check_regimes([regime])
    limit = np.inf if settings.time_limit_s is None else settings.time_limit_s

    def solve(instance: Instance) -> Solution:
        check_step(koopman, instance)
        started = time.perf_counter()
        condensed = _condensed(_Model(case, koopman.fingerprint, instance.steps, koopman))
        psi = koopman.initial(Network(case), [instance])[0]
        free = koopman.free_response(psi, instance.p_load(case))
        build_s = time.perf_counter() - started
        started = time.perf_counter()
        answer = _solve(case, condensed, instance, regime, free, started + limit)
        done = answer.status == Status.OPTIMAL
        schedule = Schedule(t=condensed.knots, p=answer.x.reshape(N_KNOTS, -1)) if done else None
        return Solution(
            status=answer.status,
            schedule=schedule,
            iterations=answer.iterations,
            build_s=build_s,
            setup_s=0.0,
            solve_s=time.perf_counter() - started,
            solver_objective=answer.objective if done else None,
            solver_version=condensed.program.version,
            error="" if done else answer.status.sentence,
        )

    return solve


@dataclass(frozen=True)
class _Model:
    """What the condensed model depends on; Koopman models are equal if their fingerprints are."""

    case: Case
    fingerprint: str
    steps: int
    koopman: Koopman = field(compare=False)


class _Condensed(NamedTuple):
    """(ω, P_s) at the points as maps of x, the knots of all generators, and the LP that uses them."""

    knots: Array  # times, shape (n_knots,), s
    gamma: Array  # (n_gen + 1, n_points, n_x): of the ω, then of P_s
    blocks: list[tuple[Array, Array]]  # the same by time, each as a product of two small matrices
    p_slack_sum: Array  # (n_points + 1, n_x): P_s summed over all points before one
    weight: Array  # (n_knots,): how often a knot counts in the sum over all points
    first: Indices  # first point of each piece, shape (n_pieces,)
    program: GrowingProgram  # variables (x, cost of each piece); rows: ramps, pieces as +P_s, as -P_s


@functools.lru_cache(maxsize=1)
def _condensed(model: _Model) -> _Condensed:
    n_gen = len(model.case.generators)
    grid = np.asarray(np.arange(model.steps + 1) * model.koopman.dt_s, dtype=np.float64)
    knots = np.linspace(0.0, float(grid[-1]), N_KNOTS, dtype=np.float64)
    gamma = model.koopman.condense(n_gen, grid, knots).reshape(len(grid), n_gen + 1, -1)
    gamma = np.ascontiguousarray(np.moveaxis(gamma, 1, 0))
    first = np.unique(np.linspace(0, len(grid), N_PIECES, endpoint=False).astype(int))
    p_slack_sum = _sums(gamma[n_gen])
    pieces = sp.csr_matrix(np.diff(p_slack_sum[np.append(first, len(grid))], axis=0))
    ramps = sp.csr_matrix(np.kron(np.diff(np.eye(N_KNOTS), axis=0), np.eye(n_gen)))
    above = sp.eye(len(first))
    blocks: Any = [[ramps, None], [pieces, -above], [-pieces, -above]]
    program = GrowingProgram(sp.csr_matrix(sp.bmat(blocks)))
    held = hat_functions(grid, knots).sum(axis=0)
    return _Condensed(knots, gamma, _blocks(gamma), p_slack_sum, held, first, program)


def _blocks(gamma: Array) -> list[tuple[Array, Array]]:
    """Cut a map from knots to points by time, and each part into two factors without what is round-off."""
    blocks = []
    for part in np.array_split(gamma, N_BLOCKS, axis=1):
        left, size, right = np.linalg.svd(part.reshape(-1, part.shape[2]), full_matrices=False)
        rank = int((size > 1e-14 * size[0]).sum())
        left = (left * size)[:, :rank].reshape(*part.shape[:2], rank)
        blocks.append((np.ascontiguousarray(left), right[:rank].copy()))
    return blocks


def _sums(values: Array) -> Array:
    """Sums over everything before each row, and over everything."""
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


class _Answer(NamedTuple):
    status: Status
    x: Array
    objective: float
    iterations: int


def _solve(
    case: Case, condensed: _Condensed, instance: Instance, regime: str, free: Array, deadline: float
) -> _Answer:
    """Solve, look at all points, add what is missing, and again.

    Args:
        free: (ω, P_s) without generator power, shape (n_points, n_gen + 1).
        deadline: on the clock of `time.perf_counter`.
    """
    n_gen, n_x = len(case.generators), condensed.gamma.shape[2]
    bound, price = case.omega_bound(regime), instance.cost_slack(case)
    cost = np.outer(condensed.weight, instance.cost_gen(case)).ravel()
    _restart(case, condensed, instance, np.append(cost, np.full(len(condensed.first), price)), free)
    program, iterations = condensed.program, 0
    free_by_output, free_sum = np.ascontiguousarray(free.T), _sums(free[:, n_gen])
    limited: set[tuple[int, int]] = set()  # (generator, point) whose frequency has a row
    for _ in range(MAX_ROUNDS):
        status, solution, count = program.solve(max(deadline - time.perf_counter(), 0.0))
        iterations += count
        if status != Status.OPTIMAL:
            return _Answer(status, solution, np.nan, iterations)
        x, pieces = solution[:n_x], solution[n_x:]
        values = np.concatenate([left @ (right @ x) for left, right in condensed.blocks], axis=1)
        values += free_by_output
        omega, p_slack = values[:n_gen], values[n_gen]
        short = np.add.reduceat(np.abs(p_slack), condensed.first) - pieces
        objective = float(cost @ x + price * (pieces + short).sum())
        peaks = _peaks(omega, bound) - limited
        cuts = _short_pieces(price * short, COST_TOLERANCE * abs(objective))
        if not peaks and not len(cuts):
            return _Answer(Status.OPTIMAL, x, objective, iterations)
        if peaks:
            g, k = np.array(sorted(peaks)).T
            rows = np.hstack([condensed.gamma[g, k], np.zeros((len(k), len(pieces)))])
            program.add(rows, -bound - free[k, g], bound - free[k, g])
            limited |= peaks
        if len(cuts):
            program.add(*_cuts(condensed, free_sum, p_slack, cuts))
    return _Answer(Status.FAILED, solution, np.nan, iterations)


def _restart(case: Case, condensed: _Condensed, instance: Instance, cost: Array, free: Array) -> None:
    """Give the LP an instance's numbers: P_0, ramps between knots, and ±P_s summed over each piece."""
    n_gen, n_pieces = len(case.generators), len(condensed.first)
    lower = np.append(np.tile(case.p_min, N_KNOTS), np.zeros(n_pieces))
    upper = np.append(np.tile(case.p_max, N_KNOTS), np.full(n_pieces, np.inf))
    p_initial = instance.p_initial(case)
    lower[:n_gen] = upper[:n_gen] = p_initial
    # P_0 is given, wherever it lies, but the limits hold from t_1 on, long before the next knot.
    part = min(1.0, instance.dt_s / float(condensed.knots[1]))
    second = slice(n_gen, 2 * n_gen)
    lower[second] = np.maximum(case.p_min, (case.p_min - (1 - part) * p_initial) / part)
    upper[second] = np.minimum(case.p_max, (case.p_max - (1 - part) * p_initial) / part)
    ramp = np.repeat(case.ramp_pu_per_s * np.diff(condensed.knots), n_gen)
    known = np.add.reduceat(free[:, n_gen], condensed.first)
    nothing = np.full(2 * n_pieces, -np.inf)
    row_lower, row_upper = np.append(-ramp, nothing), np.concatenate([ramp, -known, known])
    condensed.program.restart(cost, lower, upper, row_lower, row_upper)


def _peaks(omega: Array, bound: float) -> set[tuple[int, int]]:
    """(generator, point) of every peak of |ω| near its bound, if some |ω| is beyond it after t_0.

    Args:
        omega: shape (n_gen, n_points), rad/s.
    """
    size = np.abs(omega)
    size[:, 0] = 0.0  # x_0 is given, wherever it lies
    if size.max() <= bound + OMEGA_TOLERANCE:
        return set()
    after = np.append(size[:, 1:], np.zeros((len(size), 1)), axis=1)
    before = np.append(np.zeros((len(size), 1)), size[:, :-1], axis=1)
    g, k = np.nonzero((size >= before) & (size >= after) & (size > NEAR * bound))
    return set(zip(g.tolist(), k.tolist(), strict=True))


def _short_pieces(short: Array, tolerance: float) -> Indices:
    """Pieces whose variable lies below the cost of their P_s, if together they matter."""
    if np.maximum(short, 0.0).sum() <= tolerance:
        return np.array([], dtype=int)
    return np.flatnonzero(short > tolerance / len(short))


def _cuts(
    condensed: _Condensed, free_sum: Array, p_slack: Array, pieces: Indices
) -> tuple[Array, Array, Array]:
    """Rows Σ sign(P_s) P_s <= variable of a piece, with the signs at the present solution.

    Args:
        free_sum: P_s without generator power, summed over all points before one.
    """
    first, n_pieces = condensed.first, len(condensed.first)
    sign = np.where(p_slack > 0, 1.0, -1.0)
    start = np.union1d(first, np.flatnonzero(np.diff(sign)) + 1)  # of stretches of one sign in one piece
    ends, piece = np.append(start, len(sign)), np.searchsorted(start, first)
    across = np.add.reduceat(sign[start, None] * np.diff(condensed.p_slack_sum[ends], axis=0), piece)
    known = np.add.reduceat(sign[start] * np.diff(free_sum[ends]), piece)
    rows = np.hstack([across[pieces], -np.eye(n_pieces)[pieces]])
    return rows, np.full(len(pieces), -np.inf), -known[pieces]
