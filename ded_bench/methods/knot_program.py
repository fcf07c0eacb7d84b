"""The linear program over schedules linear between knots, on a linear model along a trajectory.

Variables are input increments u = δP and deviations x at the knots, and s_p >= |Σ P_s| over every piece p of
a few grid points (see `divide`), so that every row is local to one interval between knots:

    min  Σ_j weight_j c · (P_j + u_j) + c_s Σ_p s_p
    x_{j+1} = F_j x_j + G_j u_j + H_j (u_{j+1} - u_j) / length_j
    limits on P, on its ramps, and on outputs of ω at the knots and at chosen points between them

Beside a slack the program is **partially condensed**: a stage joins intervals, and x has columns at its end
only. At knots within it limits are rows, as between knots. Larger blocks are fewer; that pays where few
set-points are free.

On islands, which have many more states than set-points, the program is **condensed**: x is substituted, and
u are its only columns. A row of an output is then dense, so that limits at knots, too, have rows only where
they may bind; the answer is that of all of them.

The outputs are those that the regime bounds (`problem.limits.Bounds`): ω itself, or its mean and the swings
about it. Where the plant delivers other powers than its set-points, what is delivered is paid. Few of the
limits between knots bind: they get rows as solutions ask for them (`slp.solve_with_rows_added`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.methods.knot_columns import BasisByPlaces, FixedSetPoints, KnotColumns, OutputRows, pieces_of
from ded_bench.methods.knots import divided, knot_weights
from ded_bench.methods.reserve import Room
from ded_bench.plants.plant import PlantState
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.highs import solve_form as solve_by_highs
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, with_empty_columns
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status

#: PIQP factorises dense blocks; but with a knot at every point, and fewer than so many columns for each, a
#: sparse matrix is faster.
LONG = 20
#: What widening limits of outputs by 1 rad/s costs, in sums of all columns' costs: where they are widened as
#: little as possible, and where a program prices every excess from the start: an exact penalty above nearly
#: all multipliers of the limits.
LEAST_PRICE, SOFT_PRICE = 100.0, 10.0
#: Where an output exceeds this part of its bound it gets rows: at peaks, at so many points of an interval. A
#: peak beyond the last part moves when it is cut off: the two points on either side of it get rows, too.
NEAR, PARTS, CUT = 0.9, 6, 0.99
#: A row of a condensed program is dense: at knots a limit has one if the trajectory exceeds this part of the
#: bound, or an answer exceeds that part when another row is missing; between knots where the bound is
#: exceeded, at peaks and at so many points of an interval. Chosen on validation draws of two-area-agc and
#: 39bus-agc: of 1, 2, 4, 8 points, with and without those beside a peak, the fastest.
HELD, KNOT_NEAR, FEW_PARTS = 0.5, 0.98, 2
#: At knots within a stage all limits have rows in a first program, and in the next ones those where the
#: trajectory exceeds this part of the bound. Of 0, 0.5, 0.75, 0.9 the fastest on validation draws of 39bus.
HELD_AGAIN = 0.75
#: What |P_s| may cost beyond what its pieces pay for, as a part of all; validation draws have up to 1.7e-5.
#: Where its sign was taken to stay, what shows that it did not.
CANCELLED, STAYED = 1e-4, 1e-7
#: Output, grid point, and the sign of the bound that it comes near, of a limit between knots with states.
Limit = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Prediction:
    """A solution of a program, and what the linear model says about all grid points."""

    p_gen: Array  # (n_knots, n_gen), pu
    outputs: Array  # (n_points, n_out), rad/s
    p_slack: Array  # (n_points,), pu
    objective: float  # with |P_s| at every point


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan to correct, by a program whose excess over bounds has a price."""

    last: Schedule | None  # the plan in force, on the time of the instance; None: the static dispatch
    room: Room | None = None  # for surprises
    state: PlantState = None  # of the plant at t = 0; None: the instance's
    margin: Array | None = None  # by how much bounds are tighter at every grid point, (n_points,), rad/s


class KnotProgram:
    """The program around one trajectory. P_0 and x_0 are given: the first knot has no columns.

    After an interval's columns (`knot_columns`) come, where limits of outputs may be exceeded, how much, then
    what room for surprises needs.

    Args:
        case: the grid.
        instance: costs and P_0.
        bounds: of outputs of ω.
        model: a linear model along a trajectory that starts at P_0.
        plan: to correct, if any: its margin, and its room where excess has a price.
        radius: most that a set-point may move, pu (trust region).
        before: the program along the trajectory before, near whose end to start.
        error: of the objective that PIQP may leave, in its unit.
    """

    def __init__(
        self,
        case: Case,
        instance: Instance,
        bounds: Bounds,
        model: TimeVarying,
        plan: Plan | None = None,
        radius: float = np.inf,
        before: KnotProgram | None = None,
        error: float = 0.0,
    ) -> None:
        self.model = model = model.monitored(bounds.matrix)
        self.bounds, self._radius, self._surprises = bounds, radius, plan.room if plan else None
        self._error = error
        self._margin = np.zeros(len(model.omega)) if plan is None or plan.margin is None else plan.margin
        self._case, self._instance, self._n = case, instance, len(model.lengths)
        pieces = None if plan is None else pieces_of(model)
        if before is not None and len(before._columns.signs) > 1:
            pieces = before._columns.pieces
        self.fixed = FixedSetPoints((self._n, len(case.generators)))
        if before is not None and np.isinf(radius):
            self.fixed = before.fixed
        self._columns: KnotColumns = KnotColumns(case, instance, model, self._stage(), pieces)
        self._output_rows = OutputRows(model)
        self._all_costs = (self._columns.generation[1:] if self.condensed else self._columns.cost).sum()
        bounded = np.isfinite(self._room(model.points[1:])[1]).reshape(self._n, -1)
        size = np.abs(model.omega[model.points[1:]])
        #: Limits at knots: all, and those kept from the start, by knots and outputs.
        self._bounded = self._held = bounded
        if self.condensed:
            self._held = bounded & (size > HELD * bounds.limit)
        elif before is not None:
            self._held = bounded & (size > HELD_AGAIN * bounds.limit)
            self._held[self._columns.ends] = bounded[self._columns.ends]
        self._basis: BasisByPlaces | None = None
        if before is not None and self.condensed:
            self._held, self._basis = self._held | before._held, before._basis

    @property
    def condensed(self) -> bool:
        """Whether states are substituted: on islands."""
        return self._case.slack is None

    def solve(self, limits: Indices, time_limit_s: float) -> FormAnswer:
        """Solve with outputs limited, either way, at the knots held and at the points chosen.

        Args:
            limits: at these points, rows of `Limit`, shape (n_limits, 3).
            time_limit_s: see `piqp.solve_form`.
        """
        limits = np.unique(limits[:, :2], axis=0)

        def once(left_s: float) -> tuple[FormAnswer, Array]:
            deadline = time.perf_counter() + left_s
            free = self._columns.program(self._radius)
            form = self.fixed.in_program(free, self._columns.u)
            held, low, high = self._held, *self._room(limits[:, 1], limits[:, 0])
            least, most = self._room(self.model.points[1:])
            if self.model.matrix is None and not self.condensed:
                ends, speed = self._columns.ends, self._columns.x[:, self.model.speed]
                form.lower[speed], form.upper[speed] = (
                    bound.reshape(held.shape)[ends] for bound in (least, most)
                )
                held = held.copy()
                held[ends] = False
            rows = self._rows(held, limits)
            low, high = np.append(least[held.ravel()], low), np.append(most[held.ravel()], high)
            form, none = form.with_rows(rows, low, high), np.zeros(self._n)
            if self.condensed:
                return self._by_simplex(form, self._output_rows.places(self._held, limits), left_s), none
            answer = solve_form(form, left_s, staged=not self._is_sparse, error=self._error)
            is_fixed = self.fixed.at.any()
            if answer.status == Status.FAILED and (is_fixed or len(self._columns.signs) == 1):
                if is_fixed:  # with all free, or else with both signs, it may succeed
                    self.fixed = FixedSetPoints(self._columns.u.shape)
                else:
                    self._divide_at(pieces_of(self.model))
                other, _ = once(max(deadline - time.perf_counter(), 0.0))
                answer = replace(other, iterations=answer.iterations + other.iterations)
            elif answer.status == Status.OPTIMAL:
                self.fixed.choose(free, self._columns.u, answer)
            return answer, none

        return self._at_all_knots(once, time_limit_s)[0]

    def solve_relaxed(
        self, limits: Indices, time_limit_s: float, price: float = LEAST_PRICE
    ) -> tuple[FormAnswer, Array]:
        """Solve with limits of outputs widened in every interval, and with room for surprises.

        What PIQP does not solve it solves with dense blocks instead of a sparse matrix, or HiGHS does.

        Args:
            limits, time_limit_s: see `solve`; limits between knots have rows for their own sign only.
            price: of widenings; with LEAST_PRICE their sum is the least but for round-off.

        Returns:
            The answer, whose objective is not that of the schedule alone; and how far limits are widened in
            each interval, (n_intervals,), rad/s.
        """

        def once(left_s: float) -> tuple[FormAnswer, Array]:
            deadline = time.perf_counter() + left_s
            form, place, widening = self._relaxed(limits, price)
            if self._surprises is not None:
                form, moved = self._with_room(self._surprises, form, place, widening)
                place, widening = moved[place], moved[widening]
            if self.condensed:
                places, (up, down) = self._output_rows.places(self._held, limits), self._sides(limits)
                answer = self._by_simplex(form, np.append(places[up], -1 - places[down]), left_s)
            else:
                answer = solve_form(form, left_s, staged=not self._is_sparse)
                if answer.status == Status.FAILED and self._is_sparse:
                    other = solve_form(form, max(deadline - time.perf_counter(), 0.0), staged=True)
                    answer = replace(other, iterations=answer.iterations + other.iterations)
                if answer.status == Status.FAILED:
                    other = solve_by_highs(form, max(deadline - time.perf_counter(), 0.0))
                    version, iterations = f"{answer.version}, {other.version}", answer.iterations
                    answer = replace(other, iterations=iterations + other.iterations, version=version)
            if answer.status != Status.OPTIMAL:
                return answer, np.zeros(self._n)
            return replace(answer, x=answer.x[place]), answer.x[widening]

        return self._at_all_knots(once, time_limit_s)

    def _by_simplex(self, form: FreeForm, places: Indices, left_s: float) -> FormAnswer:
        """HiGHS's, from where the last program ended; `places` are those of the last rows."""
        start = None
        if self._basis is not None and len(self._basis.columns) == len(form.cost):
            start = self._basis.start(places)
        answer = solve_by_highs(form, max(left_s, 0.0), start)
        if answer.status == Status.OPTIMAL and answer.basis is not None:
            self._basis = BasisByPlaces.of(answer.basis, places)
        return answer

    def _at_all_knots(
        self, once: Callable[[float], tuple[FormAnswer, Array]], time_limit_s: float
    ) -> tuple[FormAnswer, Array]:
        """Solve until limits at knots that have no row yet are kept, too; and how far they are widened.

        Args:
            once: solves in a time, s, with rows for those held; how far limits are widened at each knot but
                the first follows the answer, (n_intervals,), rad/s.
            time_limit_s: s.
        """
        deadline, iterations = time.perf_counter() + time_limit_s, 0
        while True:
            answer, widened = once(deadline - time.perf_counter())
            iterations += answer.iterations
            if self.condensed and answer.status == Status.OPTIMAL and not self._held.all():
                u = np.zeros_like(self.model.p_gen)
                u[1:] = answer.x[self._columns.u]
                now = self.model.omega[self.model.points[1:]] + self.model.states(u)[1:] @ self.model.output.T
                beyond = np.abs(now) - self.bounds.limit - widened[:, None]
                missing = self._bounded & ~self._held & (beyond > (KNOT_NEAR - 1.0) * self.bounds.limit)
                if (beyond[missing] > 0.0).any():
                    self._held = self._held | missing
                    continue
            return replace(answer, iterations=iterations), widened

    def near(self, outputs: Array, left_open: float = 0.0, widened: Array | None = None) -> set[Limit]:
        """Points between knots, and knots not held, at which an output comes near its bound.

        Args:
            outputs: shape (n_points, n_out), rad/s.
            left_open: excess that needs no row, rad/s.
            widened: how far limits are widened in each interval, (n_intervals,), rad/s; None: they cannot be.
        """
        parts = FEW_PARTS if self.condensed else PARTS
        least = left_open if self.condensed else (NEAR - 1.0) * self.bounds.limit[:, None]
        points, beyond = self.model.points, self._beyond(outputs, widened).T
        chosen = np.zeros(beyond.shape, dtype=bool)
        peak = (beyond[:, 1:-1] >= beyond[:, :-2]) & (beyond[:, 1:-1] >= beyond[:, 2:])
        chosen[:, 1:-1] = peak
        if not self.condensed:
            of, k = np.nonzero(peak & (beyond[:, 1:-1] > (CUT - 1.0) * self.bounds.limit[:, None]))
            for beside in (-2, -1, 1, 2):
                chosen[of, np.clip(k + 1 + beside, 0, points[-1])] = True
        chosen[:, divided(points, np.full(len(points) - 1, parts))] = True
        if widened is not None:  # coming back from beyond a bound, outputs are most where an interval begins
            chosen[:, points[:-1] + 1] |= beyond[:, points[:-1] + 1] > 0.0
        chosen[:, points] = False
        if not self.condensed:
            chosen[:, points[1:]] = (self._bounded & ~self._held).T
        of, k = np.nonzero(chosen & (beyond > least))
        sign = np.where(outputs[k, of] < 0.0, -1, 1)
        return set(zip(of.tolist(), k.tolist(), sign.tolist(), strict=True))

    def excess(self, outputs: Array, widened: Array | None = None) -> float:
        """Largest excess over a bound after t_0: x_0 is given, wherever it lies; rad/s. See `near`."""
        return float(self._beyond(outputs, widened)[1:].max())

    def _beyond(self, outputs: Array, widened: Array | None) -> Array:
        """How far outputs are beyond what margins leave of widened bounds, (n_points, n_out), rad/s."""
        beyond = self.bounds.beyond(outputs) + self._margin[:, None]
        if widened is not None:
            beyond[1:] -= np.repeat(widened, self.model.lengths)[:, None]
        return beyond

    def predict(self, columns: Array) -> Prediction:
        """All grid points at a solution, shape (n_columns,)."""
        model = self.model
        p_gen = np.array(model.p_gen)
        p_gen[1:] = np.clip(p_gen[1:] + columns[self._columns.u], self._case.p_min, self._case.p_max)
        outputs, p_slack = model.outputs(p_gen - model.p_gen)
        if model.delivered is None:
            generation = float((self._columns.generation * p_gen).sum())
        else:
            paid = np.append(self._columns.u, self._columns.x)
            along = model.delivered.p_gen @ self._instance.cost_gen(self._case)
            generation = float(along.sum() + self._columns.cost[paid] @ columns[paid])
        cost = generation + self._columns.slack_price * float(np.abs(p_slack).sum())
        return Prediction(p_gen, outputs, p_slack, cost)

    def divide(self, columns: Array, predicted: Prediction) -> bool:
        """Divide pieces in which P_s changes sign, if what cancels matters to the cost; whether it did."""
        old, size = self._columns, np.abs(predicted.p_slack)
        unpaid = old.slack_price * float(size.sum() - columns[old.s].sum())
        is_steady = len(old.signs) == 1
        if unpaid <= (STAYED if is_steady else CANCELLED) * abs(predicted.objective):
            return False
        pieces = pieces_of(self.model)
        if is_steady:
            self.fixed = FixedSetPoints(old.u.shape)  # by the prices of a program that paid too little
        else:
            owner = np.searchsorted(old.pieces, np.arange(len(size) - 1), side="right") - 1
            sums, sizes = (np.add.reduceat(values, old.pieces) for values in (predicted.p_slack, size))
            cancels = sizes - np.abs(sums) > 1e-9 * sizes
            pieces = np.union1d(old.pieces, np.flatnonzero(cancels[owner]))
        self._divide_at(pieces)
        return is_steady or len(pieces) > len(old.pieces)

    def _divide_at(self, pieces: Indices) -> None:
        """Let |P_s| be paid by pieces that begin at these grid points, with rows of both signs."""
        self._columns = KnotColumns(self._case, self._instance, self.model, self._columns.stage, pieces)

    def _stage(self) -> int:
        """How many intervals a stage has; 0: the program is condensed."""
        if self.condensed:
            return 0
        if self._every_point or self._surprises is not None:  # room for surprises needs x at all knots
            return 1
        return self.fixed.stage(self.model.slack.shape[1])

    @property
    def _every_point(self) -> bool:
        """Whether all grid points are knots."""
        return self._n == len(self.model.omega) - 1

    @property
    def _is_sparse(self) -> bool:
        """Whether PIQP is given a sparse matrix: knots at all grid points, and few columns at each."""
        return self._every_point and self._columns.count < LONG * self._n

    def _relaxed(self, limits: Indices, price: float) -> tuple[FreeForm, Indices, Indices]:
        """The program with columns for widenings; where its own columns stand then, and these."""
        form = self._columns.program(self._radius)
        held = self._held.ravel()
        own = np.append(np.nonzero(self._held)[0], np.searchsorted(self.model.points, limits[:, 1]) - 1)
        after, none = self._columns.last, np.zeros(self._n)
        form, place, new = form.with_columns(
            after, none + price * max(self._all_costs, 1.0), none, none + np.inf
        )
        outputs = with_empty_columns(self._rows(self._held, limits), after)
        one = np.ones(len(own)), (np.arange(len(own)), new[own])
        widening = sp.csr_matrix(one, outputs.shape)
        ends = self._room(self.model.points[1:]), self._room(limits[:, 1], limits[:, 0])
        low, high = (np.append(knots[held], chosen) for knots, chosen in zip(*ends, strict=True))
        up, down = self._sides(limits)
        rows = sp.vstack([(outputs - widening)[up], (-outputs - widening)[down]])
        most = np.append(high[up], -low[down])
        return form.with_rows(rows, np.full(len(most), -np.inf), most), place, new

    def _sides(self, limits: Indices) -> tuple[Indices, Indices]:
        """Rows of outputs that may not go up, and not down: at knots both, between them by their signs."""
        sign = np.append(np.zeros(np.count_nonzero(self._held), dtype=int), limits[:, 2])
        return np.flatnonzero(sign >= 0), np.flatnonzero(sign <= 0)

    def _with_room(
        self, room: Room, form: FreeForm, place: Indices, excess: Indices
    ) -> tuple[FreeForm, Indices]:
        """A program with room to follow ramps at the next knots, and where its columns stand then."""
        mean = float(np.mean(list(self._instance.cost.values())))
        shortage = room.price * mean * knot_weights(self.model.lengths)[1:] / room.limit
        points, x = self.model.points[1:], self._columns.x[:, self.model.speed]
        at = self.model.p_gen[1:], self.model.omega[points]
        return room.required(form, (place[self._columns.u], place[x]), at, excess, shortage)

    def _room(self, points: Indices, outputs: Indices | None = None) -> tuple[Array, Array]:
        """How far outputs may go down and up: at points of all of them, or at pairs of both; rad/s."""
        is_free = self.bounds.at_end & (points[:, None] < self.model.points[-1])
        limit = np.where(is_free, np.inf, self.bounds.limit - self._margin[points, None])
        now = self.model.omega[points]
        if outputs is not None:
            pairs = np.arange(len(points)), outputs
            limit, now = limit[pairs], now[pairs]
        return (-limit - now).ravel(), (limit - now).ravel()

    def _rows(self, held: NDArray[np.bool_], limits: Indices) -> sp.csc_matrix:
        """Outputs at knots, by a mask like `_held`, and between them whose limits have rows."""
        if self.condensed:  # the only columns are those of set-points
            return self._output_rows.matrix(self._output_rows.places(held, limits))
        knot, output = np.nonzero(held)
        points = np.append(self.model.points[1:][knot], limits[:, 1])
        rows = self.model.output_rows(np.append(output, limits[:, 0]), points)
        return self._columns.matrix(len(points), self._columns.local(rows, np.arange(len(points))))
