"""The linear program over schedules linear between knots, on a linear model along a trajectory.

`ded-slp` solves it along one trajectory after another, `ded-ko` and `ded-ko-knots` once on a surrogate.

Variables are input increments u = δP and deviations x at the knots, and s_p >= |Σ P_s| over
every piece p of a few grid points, so that every row is local to one interval between knots:

    min  Σ_j weight_j c · (P_j + u_j) + c_s Σ_p s_p
    x_{j+1} = F_j x_j + G_j u_j + H_j (u_{j+1} - u_j) / length_j
    limits on P, on its ramps, and on ω at the knots and at chosen points between them

Few of the limits between knots bind: they get rows as solutions ask for them (`solve_with_rows_added`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from ded_bench.methods.knots import divided, knot_weights, piece_starts, power_limits
from ded_bench.plants.time_varying import Indices, LocalRows, TimeVarying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.solvers.highs import solve_form as solve_by_highs
from ded_bench.solvers.linear_program import FormAnswer, FreeForm
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status

#: Entries of rows below this are left out: they are what a double leaves of zero.
ROUND_OFF = 1e-13
#: Whether PIQP factorises dense blocks, and its regularisation; the next where one stalls. A sparse matrix is
#: faster with a knot at every point, and fewer than LONG columns for each. Chosen on validation draws.
SPARSE, DENSE = ((False, 1e-10), (True, 1e-11)), ((True, 1e-10), (True, 1e-9), (True, 1e-11))
LONG = 20
#: What widening the limits of |ω| by 1 rad/s costs in a relaxed program, in sums of all columns' costs. Where
#: PIQP stalls within a radius the next is tried. Chosen on validation draws (39bus on AC).
WIDENING_PRICES = 100.0, 10.0, 1.0
#: Where |ω| exceeds this part of the bound it gets rows: at peaks, and at so many points of an interval.
NEAR, PARTS = 0.9, 8
#: Programs on one linear model.
MAX_PROGRAMS = 15

#: (generator, grid point) of a limit of |ω| between knots.
Limit = tuple[int, int]
#: Row numbers, column numbers and values of dense blocks, stacked or single.
Block = tuple[Indices, Indices, Array]


@dataclass(frozen=True, eq=False)
class Prediction:
    """A solution of a program, and what the linear model says about all grid points."""

    p_gen: Array  # (n_knots, n_gen), pu
    omega: Array  # (n_points, n_gen), rad/s
    p_slack: Array  # (n_points,), pu
    objective: float  # with |P_s| at every point


class KnotProgram:
    """The program around one trajectory. P_0 and x_0 are given: the first knot has no columns.

    Columns of an interval, one after another: s of its pieces, then u and x at its end.

    Args:
        case: the grid.
        instance: costs and P_0.
        bound: limit of |ω|, rad/s.
        model: a linear model along a trajectory that starts at P_0.
    """

    def __init__(self, case: Case, instance: Instance, bound: float, model: TimeVarying) -> None:
        self.model, self.bound = model, bound
        #: How far powers may differ from the trajectory's, pu.
        self.radius = np.inf
        self._case, self._instance = case, instance
        self._n, self._n_gen = len(model.lengths), len(case.generators)
        self.pieces = piece_starts(model.points)
        first = np.searchsorted(self.pieces, model.points[:-1])
        owner = np.searchsorted(model.points[:-1], self.pieces, side="right") - 1
        own = np.append(first[1:], len(self.pieces))  # columns s up to the end of an interval
        n_state = model.slack.shape[1]
        at_end = self._n_gen + n_state
        self._s = np.arange(len(self.pieces)) + at_end * owner
        power = (own + at_end * np.arange(self._n))[:, None]
        self._u, self._x = power + np.arange(self._n_gen), power + self._n_gen + np.arange(n_state)
        self._speed = self._x[:, model.speed]
        self._n_columns = len(self.pieces) + at_end * self._n
        self._durations = model.lengths * instance.dt_s
        self._price = instance.cost_slack(case)
        self._generation = knot_weights(model.lengths)[:, None] * instance.cost_gen(case)
        self._cost = self._columns_cost()
        self._dynamics, self._slack = self._dynamics_rows(), self._slack_rows()

    def solve(self, limits: Indices, time_limit_s: float) -> FormAnswer:
        """Solve with |ω| limited at all knots and at the points chosen.

        Args:
            limits: (generator, grid point) of the limits between knots, shape (n_limits, 2).
            time_limit_s: see `piqp.solve_form`.
        """
        return self._answer(self._form(limits), time_limit_s)

    def solve_relaxed(
        self, limits: Indices, time_limit_s: float, by_interval: bool = False
    ) -> tuple[FormAnswer, float]:
        """Solve with the limits of |ω| widened as little as possible; what PIQP does not solve HiGHS does.

        The cost counts, but so little that the widening is the least one but for round-off. Within a radius
        the cost may count more, and HiGHS is not asked: a smaller radius may follow.

        Args, but for those of `solve`:
            by_interval: every interval has a widening of its own, and their sum is the least; else all
                have the same.

        Returns:
            The answer, and the largest widening in rad/s.
        """
        started, is_free, iterations = time.perf_counter(), self.radius == np.inf, 0
        for price in WIDENING_PRICES[:1] if is_free else WIDENING_PRICES:
            form, order = self._relaxed_form(limits, by_interval, price)
            answer = self._answer(form, time_limit_s - (time.perf_counter() - started))
            iterations += answer.iterations
            answer = replace(answer, iterations=iterations)
            if answer.status != Status.FAILED:
                break
        if answer.status == Status.FAILED and is_free:
            other = solve_by_highs(form, max(time_limit_s - (time.perf_counter() - started), 0.0))
            version = f"{answer.version}, {other.version}"
            answer = replace(other, iterations=answer.iterations + other.iterations, version=version)
        if answer.status != Status.OPTIMAL:
            return answer, np.inf
        x = np.empty(len(order))
        x[order] = answer.x
        return replace(answer, x=x[: self._n_columns]), float(x[self._n_columns :].max())

    def near(self, omega: Array) -> set[Limit]:
        """Points between knots at which |ω| comes near the bound.

        Args:
            omega: shape (n_points, n_gen), rad/s.
        """
        size, points = np.abs(omega.T), self.model.points
        chosen = np.zeros(size.shape, dtype=bool)
        peak = (size[:, 1:-1] >= size[:, :-2]) & (size[:, 1:-1] >= size[:, 2:])
        chosen[:, 1:-1] = peak
        # A peak that is cut off moves to the points beside it.
        over = peak & (size[:, 1:-1] > self.bound)
        chosen[:, :-2] |= over
        chosen[:, 2:] |= over
        chosen[:, divided(points, np.full(len(points) - 1, PARTS))] = True
        chosen[:, points] = False
        g, k = np.nonzero(chosen & (size > NEAR * self.bound))
        return set(zip(g.tolist(), k.tolist(), strict=True))

    def excess(self, omega: Array) -> float:
        """Largest excess of |ω| over the bound after t_0: x_0 is given, wherever it lies; rad/s."""
        return float(np.abs(omega[1:]).max()) - self.bound

    def _answer(self, form: FreeForm, time_limit_s: float) -> FormAnswer:
        deadline, iterations = time.perf_counter() + time_limit_s, 0
        n_stages = len(self.model.lengths)
        is_short = n_stages == len(self.model.omega) - 1 and self._n_columns < LONG * n_stages
        for staged, regularisation in SPARSE if is_short else DENSE:
            answer = solve_form(form, deadline - time.perf_counter(), staged, regularisation)
            iterations += answer.iterations
            stalled = answer.status == Status.FAILED and "INFEASIBLE" not in answer.message
            if not stalled or time.perf_counter() > deadline:
                break
        return replace(answer, iterations=iterations)

    def _relaxed_form(self, limits: Indices, by_interval: bool, price: float) -> tuple[FreeForm, Indices]:
        """The program with columns for widenings, and where its columns stand among the program's own."""
        form = self._form(limits)
        n, speed = self._n_columns, self._speed.ravel()
        one = np.ones(speed.size)
        at_knots = sp.csc_matrix((one, (np.arange(speed.size), speed)), (speed.size, n))
        kept = form.between.shape[0] - len(limits)
        omega = sp.csc_matrix(sp.vstack([at_knots, form.between[kept:]]))
        low, high = (
            np.append(a[speed], b[kept:]) for a, b in ((form.lower, form.low), (form.upper, form.high))
        )
        between = np.searchsorted(self.model.points, limits[:, 1]) - 1
        owner = np.append(np.repeat(np.arange(self._n), self._n_gen), between)
        # A widening stands after the column of this number, in its own stage.
        stage = self._x[:, -1] if by_interval else np.array([n])
        place = np.arange(len(owner)), owner if by_interval else np.zeros_like(owner)
        widening = sp.csc_matrix((np.ones(len(owner)), place), (len(owner), len(stage)))
        below, none = np.full(len(low), -np.inf), np.zeros(len(stage))
        lower, upper = np.append(form.lower, none), np.append(form.upper, none + np.inf)
        lower[speed], upper[speed] = -np.inf, np.inf
        rows: Any = [[form.between[:kept], None], [omega, -widening], [-omega, -widening]]
        equal = sp.hstack([form.equal, sp.csc_matrix((form.equal.shape[0], len(stage)))])
        order = np.argsort(np.append(np.arange(n), stage + 0.5))
        relaxed = FreeForm(
            cost=np.append(form.cost, none + price * max(form.cost.sum(), 1.0))[order],
            equal=sp.csc_matrix(equal)[:, order],
            right=form.right,
            between=sp.csc_matrix(sp.bmat(rows))[:, order],
            low=np.concatenate([form.low[:kept], below, below]),
            high=np.concatenate([form.high[:kept], high, -low]),
            lower=lower[order],
            upper=upper[order],
        )
        return relaxed, order

    def _form(self, limits: Indices) -> FreeForm:
        model = self.model
        ramp = np.diff(model.p_gen, axis=0) / self._durations[:, None]
        slack = np.add.reduceat(model.p_slack, self.pieces)
        omega = model.omega[limits[:, 1], limits[:, 0]]
        lower, upper = self._column_limits()
        rows = [self._ramp_rows(), self._slack, self._frequency_rows(limits)]
        return FreeForm(
            cost=self._cost,
            equal=self._dynamics,
            right=np.zeros(self._x.size),
            between=sp.csc_matrix(sp.vstack(rows)),
            low=np.concatenate(
                [(-self._case.ramp - ramp).ravel(), np.full(2 * len(slack), -np.inf), -self.bound - omega]
            ),
            high=np.concatenate([(self._case.ramp - ramp).ravel(), -slack, slack, self.bound - omega]),
            lower=lower,
            upper=upper,
        )

    def predict(self, columns: Array) -> Prediction:
        """All grid points at a solution, shape (n_columns,)."""
        model = self.model
        p_gen = np.array(model.p_gen)
        p_gen[1:] = np.clip(p_gen[1:] + columns[self._u], self._case.p_min, self._case.p_max)
        omega, p_slack = model.outputs(p_gen - model.p_gen)
        if model.delivered is None:
            generation = float((self._generation * p_gen).sum())
        else:
            priced = [self._cost[part] @ columns[part] for part in (self._u.ravel(), self._x.ravel())]
            generation = float(
                (model.delivered.p_gen @ self._instance.cost_gen(self._case)).sum() + sum(priced)
            )
        return Prediction(p_gen, omega, p_slack, generation + self._price * float(np.abs(p_slack).sum()))

    def _columns_cost(self) -> Array:
        """Cost of all columns: of what generators deliver, and of |P_s|."""
        cost = np.zeros(self._n_columns)
        cost[self._s] = self._price
        if self.model.delivered is None:
            cost[self._u] = self._generation[1:]
            return cost
        rows = self.model.cost_rows(self._instance.cost_gen(self._case))
        cost[self._u] = rows.end
        cost[self._u[:-1]] += rows.start[1:]
        cost[self._x[:-1]] = rows.x[1:]
        return cost

    def _column_limits(self) -> tuple[Array, Array]:
        """Limits of all columns: of s, P and, at the knots, ω."""
        case, model = self._case, self.model
        p_min, p_max = power_limits(case, self._instance, model.lengths)
        omega = model.omega[model.points[1:]]
        lower, upper = np.full((2, self._n_columns), np.inf) * [[-1.0], [1.0]]
        lower[self._s] = 0.0
        lower[self._u] = np.maximum(p_min - model.p_gen[1:], -self.radius)
        upper[self._u] = np.minimum(p_max - model.p_gen[1:], self.radius)
        lower[self._speed], upper[self._speed] = -self.bound - omega, self.bound - omega
        return lower, upper

    def _dynamics_rows(self) -> sp.csc_matrix:
        across = self.model.across
        end = across.h / self.model.lengths[:, None, None]
        row = np.arange(self._x.size).reshape(self._n, -1)
        one = np.broadcast_to(np.eye(row.shape[1]), across.f.shape)
        blocks = [
            (row, self._x, one),
            (row, self._u, -end),
            (row[1:], self._x[:-1], -across.f[1:]),
            (row[1:], self._u[:-1], (end - across.g)[1:]),
        ]
        return self._matrix(row.size, blocks)

    def _ramp_rows(self) -> sp.csc_matrix:
        """Ramps in pu/s: what the solver leaves open is as little in a short interval as in a long one."""
        row = np.arange(self._u.size).reshape(self._n, -1)
        one = np.eye(self._n_gen) / self._durations[:, None, None]
        return self._matrix(row.size, [(row, self._u, one), (row[1:], self._u[:-1], -one[1:])])

    def _slack_rows(self) -> sp.csc_matrix:
        """Σ δP_s - s over every piece, then -Σ δP_s - s."""
        n = len(self.pieces)
        rows, place = self.model.slack_rows(self.pieces), np.arange(n)
        one = np.ones((n, 1, 1))
        blocks = self._local(rows, place) + self._local(rows, place + n, -1.0)
        blocks += [(p[:, None], self._s[:, None], -one) for p in (place, place + n)]
        return self._matrix(2 * n, blocks)

    def _frequency_rows(self, limits: Indices) -> sp.csc_matrix:
        rows = self.model.frequency_rows(limits[:, 0], limits[:, 1])
        return self._matrix(len(limits), self._local(rows, np.arange(len(limits))))

    def _local(self, rows: LocalRows, place: Indices, sign: float = 1.0) -> list[Block]:
        """Rows of intervals as blocks of one row each; the first knot has no columns."""
        later = rows.interval > 0
        before = rows.interval[later] - 1
        return [
            (place[:, None], self._u[rows.interval], sign * rows.end[:, None]),
            (place[later, None], self._u[before], sign * rows.start[later, None]),
            (place[later, None], self._x[before], sign * rows.x[later, None]),
        ]

    def _matrix(self, n_rows: int, blocks: list[Block]) -> sp.csc_matrix:
        rows = [np.broadcast_to(row[..., :, None], value.shape).ravel() for row, _, value in blocks]
        columns = [np.broadcast_to(column[..., None, :], value.shape).ravel() for _, column, value in blocks]
        values = np.concatenate([value.ravel() for _, _, value in blocks])
        kept = np.abs(values) > ROUND_OFF
        place = np.concatenate(rows)[kept], np.concatenate(columns)[kept]
        return sp.csc_matrix((values[kept], place), (n_rows, self._n_columns))


@dataclass(frozen=True, eq=False)
class Attempt:
    """What solving a program with rows added came to.

    Without a prediction the status says why. `Infeasible` comes with the schedule of least excess.
    """

    status: Status
    prediction: Prediction | None
    iterations: int
    version: str
    message: str


def solve_with_rows_added(
    program: KnotProgram,
    limits: set[Limit],
    tolerance: float,
    enough: float,
    deadline: float,
    by_interval: bool = False,
) -> Attempt:
    """Solve, look at all grid points, limit |ω| where it comes near the bound, and again.

    Args:
        program: what to solve.
        limits: limits between knots to begin with; those found to be needed are added to it.
        tolerance: excess of |ω| that needs no row, or makes nothing infeasible, rad/s.
        enough: excess of |ω| with which to stop, rad/s; no less than the tolerance.
        deadline: on the clock of `time.perf_counter`.
        by_interval: what least excess means, see `solve_relaxed`; then rows are added for it, too.
    """
    iterations, infeasible = 0, False
    for _ in range(MAX_PROGRAMS):
        rows, widening = np.array(sorted(limits), dtype=int).reshape(-1, 2), 0.0
        if not infeasible:
            answer = program.solve(rows, deadline - time.perf_counter())
            iterations += answer.iterations
        if infeasible or answer.status == Status.FAILED:  # there is no solution, or PIQP finds none
            left = deadline - time.perf_counter()
            answer, widening = program.solve_relaxed(rows, left, by_interval)
            iterations += answer.iterations
        if answer.status != Status.OPTIMAL:
            return Attempt(answer.status, None, iterations, answer.version, answer.message)
        prediction = program.predict(answer.x)
        excess, added = program.excess(prediction.omega), program.near(prediction.omega) - limits
        limits |= added if excess > tolerance else set()
        infeasible = infeasible or widening > tolerance
        is_done = not by_interval if infeasible else excess <= enough
        if is_done or not added:
            break
    status = Status.INFEASIBLE if infeasible else Status.OPTIMAL
    return Attempt(status, prediction, iterations, answer.version, answer.message)
