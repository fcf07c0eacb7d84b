"""DED-KO on few knots: the LP over all points, restricted to schedules that are linear between knots.

On the condensed rollout (ω, P_s) at every point are affine in the knots, so the knots are the only
variables. Few of the many frequency limits bind and P_s changes sign at few points; what is needed
of both is added as the solution asks for it, until all points are right.

In operation a frequency limit may be out of reach: a load has begun to ramp that nobody announced. Then
every piece of the horizon gets a variable for the frequency excess in it, and the sum of all is the
least one.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.koopman.condensed import CondensedRollout
from ded_bench.koopman.model import Koopman
from ded_bench.koopman.surrogates import find_model
from ded_bench.methods.artifact import Artifact, model_artifact
from ded_bench.methods.ded_ko import check_step
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.highs import GrowingProgram
from ded_bench.solvers.status import Status
from ded_bench.truth.network import Network

Indices = NDArray[np.intp]

SETTINGS: Mapping[str, Mapping[str, Any]] = {"default": {}}

#: The slack's cost Σ|P_s| is a sum over this many pieces of the horizon, each with a variable above it.
#: More pieces take fewer rounds, but each round longer.
N_PIECES = 70
#: What the LP may leave open at the end: frequency in rad/s (1.6e-8 Hz; HiGHS leaves as much in each
#: row), cost as a fraction of all (a hundredth of the smallest gap that tables show).
OMEGA_TOLERANCE = 1e-7
COST_TOLERANCE = 1e-6
#: What a frequency excess of 1 rad/s in one piece costs, in sums of all knots' costs: so much that none is
#: worth what it saves.
EXCESS_PRICE = 100.0
#: With a limit broken somewhere, every peak of |ω| above this part of the bound gets its row.
NEAR = 0.9
MAX_ROUNDS = 100


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The Koopman model that `prepare` would use."""
    return (model_artifact(case, settings),)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances on the Koopman model that the settings name."""
    return prepare_with(case, find_model(case, settings.model, settings.search), regime, settings)


def prepare_with(case: Case, koopman: Koopman, regime: str, settings: Settings) -> KnotSolver:
    """Return a solver of single instances; one condensed rollout per process serves them all."""
    case.check_regimes([regime])
    limit = np.inf if settings.time_limit_s is None else settings.time_limit_s
    return KnotSolver(case, koopman, regime, limit)


@dataclass(frozen=True)
class KnotSolver:
    """Solves instances of one case and regime on one Koopman model."""

    case: Case
    koopman: Koopman
    regime: str
    time_limit_s: float

    def __call__(self, instance: Instance) -> Solution:
        """Solve."""
        return self._solution(instance, soft=False)

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: of no use to this method.
        """
        return self._solution(instance, soft=True)

    def _solution(self, instance: Instance, soft: bool) -> Solution:
        case, koopman = self.case, self.koopman
        check_step(koopman, instance)
        started = time.perf_counter()
        program = _program(_Model(case, koopman.fingerprint, instance.steps, koopman))
        psi = koopman.initial(Network(case), [instance])
        free = np.ascontiguousarray(program.rollout.free_response(psi, instance.p_load(case)[None])[0])
        build_s = time.perf_counter() - started
        started = time.perf_counter()
        bound, deadline = case.omega_bound(self.regime), started + self.time_limit_s
        answer = _solve(case, program, instance, bound, free, deadline)
        if soft and answer.status == Status.INFEASIBLE:
            nearest = _solve(case, program, instance, bound, free, deadline, soft=True)
            if nearest.status == Status.OPTIMAL:
                answer = nearest._replace(status=Status.INFEASIBLE, found=True)
        done = answer.status == Status.OPTIMAL
        return Solution(
            status=answer.status,
            schedule=Schedule(program.rollout.knots, answer.p_knots) if answer.found else None,
            iterations=answer.iterations,
            build_s=build_s,
            setup_s=0.0,
            solve_s=time.perf_counter() - started,
            solver_objective=answer.objective if done else None,
            solver_version=program.lp.version,
            error="" if done else answer.status.sentence,
        )


@dataclass(frozen=True)
class _Model:
    """What the condensed rollout depends on; Koopman models are equal if their fingerprints are."""

    case: Case
    fingerprint: str
    steps: int
    koopman: Koopman = field(compare=False)


class _Program(NamedTuple):
    """The LP of a model and a time grid, and the map from its variables to (ω, P_s) at all points."""

    rollout: CondensedRollout
    p_slack_sum: Array  # (n_points + 1, n_knots n_gen): Γ of P_s summed over all points before one
    first: Indices  # first point of each piece, shape (n_pieces,)
    lp: GrowingProgram  # rows: ramps, pieces as +P_s, as -P_s; columns: see `_split`


@functools.lru_cache(maxsize=1)
def _program(model: _Model) -> _Program:
    n_gen = len(model.case.generators)
    grid = np.asarray(np.arange(model.steps + 1) * model.koopman.dt_s, dtype=np.float64)
    knots = model.case.knot_times(float(grid[-1]))
    rollout = CondensedRollout.make(model.case, model.koopman, grid, knots)
    first = np.unique(np.linspace(0, len(grid), N_PIECES, endpoint=False).astype(int))
    p_slack_sum = _sums(rollout.gamma[n_gen])
    pieces = sp.csr_matrix(np.diff(p_slack_sum[np.append(first, len(grid))], axis=0))
    ramps = sp.csr_matrix(np.kron(np.diff(np.eye(len(knots)), axis=0), np.eye(n_gen)))
    above = sp.eye(len(first))
    excess = sp.csr_matrix((ramps.shape[0], len(first)))
    blocks: Any = [[ramps, None, excess], [pieces, -above, None], [-pieces, -above, None]]
    return _Program(rollout, p_slack_sum, first, GrowingProgram(sp.csr_matrix(sp.bmat(blocks))))


def _sums(values: Array) -> Array:
    """Sums over everything before each row, and over everything."""
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


class _Answer(NamedTuple):
    status: Status
    p_knots: Array  # (n_knots, n_gen), pu; of no use unless the status is optimal
    objective: float
    iterations: int
    found: bool = False  # whether p_knots is a schedule


def _solve(
    case: Case,
    program: _Program,
    instance: Instance,
    bound: float,
    free: Array,
    deadline: float,
    soft: bool = False,
) -> _Answer:
    """Solve, look at all points, add what is missing, and again.

    Args:
        bound: of |ω|, rad/s.
        free: the free response, shape (n_gen + 1, n_points).
        deadline: on the clock of `time.perf_counter`.
        soft: the bound may be exceeded, at a price.
    """
    n_gen, rollout, lp = len(case.generators), program.rollout, program.lp
    n_pieces, price = len(program.first), instance.cost_slack(case)
    lengths = np.diff(np.append(program.first, len(rollout.points)))
    cost = np.outer(rollout.hat_weights, instance.cost_gen(case)).ravel()
    _restart(case, program, instance, cost, free, soft)
    iterations, free_sum = 0, _sums(free[n_gen])
    limited: set[tuple[int, int]] = set()  # (generator, point) whose frequency has a row
    for _ in range(MAX_ROUNDS):
        status, solution, count = lp.solve(max(deadline - time.perf_counter(), 0.0))
        iterations += count
        x, pieces, excess = _split(program, solution)
        p_knots = x.reshape(-1, n_gen)
        if status != Status.OPTIMAL:
            return _Answer(status, p_knots, np.nan, iterations)
        outputs = rollout.apply(p_knots[None])[0] + free
        omega, p_slack = outputs[:n_gen], outputs[n_gen]
        short = np.add.reduceat(np.abs(p_slack), program.first) - pieces
        objective = float(cost @ x + price * (pieces + short).sum())
        peaks = _peaks(omega, bound + np.repeat(excess, lengths)) - limited
        cuts = _short_pieces(price * short, COST_TOLERANCE * abs(objective))
        if not peaks and not len(cuts):
            return _Answer(Status.OPTIMAL, p_knots, objective, iterations, found=True)
        if peaks:
            g, k = np.array(sorted(peaks)).T
            rows = np.hstack([rollout.gamma[g, k], np.zeros((len(k), 2 * n_pieces))])
            low, high, none = -bound - free[g, k], bound - free[g, k], np.full(len(k), np.inf)
            if soft:
                own = np.searchsorted(program.first, k, side="right") - 1 - n_pieces
                rows, low, high = np.vstack([rows, rows]), np.append(-none, low), np.append(high, none)
                rows[np.arange(len(low)), np.tile(own, 2)] = np.repeat([-1.0, 1.0], len(k))
            lp.add(rows, low, high)
            limited |= peaks
        if len(cuts):
            lp.add(*_cuts(program, free_sum, p_slack, cuts))
    return _Answer(Status.FAILED, p_knots, np.nan, iterations)


def _split(program: _Program, solution: Array) -> tuple[Array, Array, Array]:
    """Columns of the program: powers at knots, cost of each piece, frequency excess in each piece."""
    n_pieces = len(program.first)
    return solution[: -2 * n_pieces], solution[-2 * n_pieces : -n_pieces], solution[-n_pieces:]


def _restart(case: Case, program: _Program, instance: Instance, cost: Array, free: Array, soft: bool) -> None:
    """Give the LP an instance's numbers: P_0, ramps between knots, and ±P_s summed over each piece."""
    n_gen, n_pieces, knots = len(case.generators), len(program.first), program.rollout.knots
    prices = instance.cost_slack(case), EXCESS_PRICE * max(float(cost.sum()), 1.0)
    cost = np.append(cost, np.repeat(prices, n_pieces))
    lower = np.append(np.tile(case.p_min, len(knots)), np.zeros(2 * n_pieces))
    upper = np.append(np.tile(case.p_max, len(knots)), np.repeat([np.inf, np.inf if soft else 0.0], n_pieces))
    p_initial = instance.p_initial(case)
    lower[:n_gen] = upper[:n_gen] = p_initial
    # P_0 is given, wherever it lies, but the limits hold from t_1 on, long before the next knot.
    part = min(1.0, instance.dt_s / float(knots[1]))
    second = slice(n_gen, 2 * n_gen)
    lower[second] = np.maximum(case.p_min, (case.p_min - (1 - part) * p_initial) / part)
    upper[second] = np.minimum(case.p_max, (case.p_max - (1 - part) * p_initial) / part)
    ramp = np.outer(np.diff(knots), case.ramp).ravel()
    known = np.add.reduceat(free[n_gen], program.first)
    without_limit = np.full(2 * n_pieces, -np.inf)
    row_lower, row_upper = np.append(-ramp, without_limit), np.concatenate([ramp, -known, known])
    program.lp.restart(cost, lower, upper, row_lower, row_upper)


def _peaks(omega: Array, bound: Array) -> set[tuple[int, int]]:
    """(generator, point) of every peak of |ω| - bound near the bound, if some |ω| is beyond it after t_0.

    Args:
        omega: shape (n_gen, n_points), rad/s.
        bound: shape (n_points,), rad/s.
    """
    size = np.abs(omega)
    size[:, 0] = 0.0  # x_0 is given, wherever it lies
    over = size - bound
    if over.max() <= OMEGA_TOLERANCE:
        return set()
    none = np.full((len(over), 1), -np.inf)
    after, before = np.append(over[:, 1:], none, axis=1), np.append(none, over[:, :-1], axis=1)
    g, k = np.nonzero((over >= before) & (over >= after) & (size > NEAR * bound))
    return set(zip(g.tolist(), k.tolist(), strict=True))


def _short_pieces(short: Array, tolerance: float) -> Indices:
    """Pieces whose variable lies below the cost of their P_s, if together they matter."""
    if np.maximum(short, 0.0).sum() <= tolerance:
        return np.array([], dtype=int)
    return np.flatnonzero(short > tolerance / len(short))


def _cuts(program: _Program, free_sum: Array, p_slack: Array, pieces: Indices) -> tuple[Array, Array, Array]:
    """Rows Σ sign(P_s) P_s <= variable of a piece, with the signs at the present solution.

    Args:
        free_sum: P_s without generator power, summed over all points before one.
    """
    first, n_pieces = program.first, len(program.first)
    sign = np.where(p_slack > 0, 1.0, -1.0)
    start = np.union1d(first, np.flatnonzero(np.diff(sign)) + 1)  # of stretches of one sign in one piece
    ends, piece = np.append(start, len(sign)), np.searchsorted(start, first)
    across = np.add.reduceat(sign[start, None] * np.diff(program.p_slack_sum[ends], axis=0), piece)
    known = np.add.reduceat(sign[start] * np.diff(free_sum[ends]), piece)
    rows = np.hstack([across[pieces], -np.eye(n_pieces)[pieces], np.zeros((len(pieces), n_pieces))])
    return rows, np.full(len(pieces), -np.inf), -known[pieces]
