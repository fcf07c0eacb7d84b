"""Columns of a program on knots, its rows, and a simplex basis by them; see `knot_program`."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from ded_bench.methods.knots import divided, knot_weights, power_limits, transfer_room
from ded_bench.plants.time_varying import LocalRows, TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance
from ded_bench.solvers.linear_program import Basis, FormAnswer, FreeForm

#: Entries of rows below this are left out: they are what a double leaves of zero.
ROUND_OFF = 1e-13
#: Grid points of a piece of Σ |P_s|, about, at first. Within one its sign is taken to be the same: of the
#: cost that leaves 3e-6 to be gained (9bus, validation draws), a third of what 40 points would.
PIECE = 20
#: P_s is taken to keep its sign if along the trajectory |P_s| is never below this part of its largest value.
STEADY = 0.1

#: A set-point that was at a limit, within this part of its range, at a reduced cost of this part of the
#: highest price or more, as were those so many knots around it, is fixed there in the next program: of 2, 4,
#: 6, 8 and 12 knots the number that makes the fewest programs (draws of 39bus with seed 1500007; on those of
#: 140bus ten times the parts change no number of programs).
AT_LIMIT, PRICED, AROUND = 1e-6, 1e-3, 8
#: With fewer generators it saves little: nothing on 39bus, a twelfth of the time on 68bus.
LEAST_GENERATORS = 20
#: Intervals of a stage, at most: six save no more than four on 140bus (studies/linear_programs.md).
LONGEST = 4


class FixedSetPoints:
    """Set-points that stay at a limit where the last program had them at a price: most need no columns.

    Args:
        shape: (n_intervals, n_gen).
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.at = np.zeros((2, *shape), dtype=bool)  # their lower limits, and their upper ones
        self.gap = 0.0  # no more than this would be saved if they were free, by weak duality

    def stage(self, n_state: int) -> int:
        """How many intervals a stage has: so many that it has as many free set-points as states."""
        n_free = np.count_nonzero(~self.at.any(axis=0)) / self.at.shape[1]
        return int(np.clip(round(n_state / max(n_free, 1.0)), 1, LONGEST))

    def in_program(self, form: FreeForm, u: Indices) -> FreeForm:
        """A program with bounds that are equal where its columns `u`, (n_intervals, n_gen), are fixed."""
        lower, upper, (low, high) = form.lower.copy(), form.upper.copy(), (u[own] for own in self.at)
        upper[low], lower[high] = form.lower[low], form.upper[high]
        return replace(form, lower=lower, upper=upper)

    def choose(self, form: FreeForm, u: Indices, answer: FormAnswer) -> None:
        """Find `gap`, and what to fix next, from an answer and the program with all set-points free."""
        if answer.reduced_cost is None or u.shape[1] < LEAST_GENERATORS:
            return
        found = answer.reduced_cost, answer.x, form.lower, form.upper
        price, x, low, high = (values[u] for values in found)
        wrong = np.where(self.at[0], -price, np.where(self.at[1], price, 0.0))
        self.gap = float((wrong.clip(0.0) * (high - low)).sum())
        least, near = PRICED * np.abs(form.cost[u]).max(), AT_LIMIT * (high - low)
        now = np.array([(x - low <= near) & (price > least), (high - x <= near) & (price < -least)])
        self.at = minimum_filter1d(now, 2 * AROUND + 1, axis=1, mode="nearest")


class OutputRows:
    """Rows of one model; those of an interval are found once, when one is asked for.

    Args:
        model: a linear model along a trajectory.
    """

    def __init__(self, model: TimeVarying) -> None:
        self._model, self._n_out = model, len(model.output)
        self._in_set_points: dict[int, Array] = {}

    def places(self, held: NDArray[np.bool_], limits: Indices) -> Indices:
        """Of limits at knots that are held, (n_intervals, n_out), and of (output, grid point) between."""
        knot, output = np.nonzero(held)
        point = np.append(self._model.points[1:][knot], limits[:, 1])
        return np.asarray(point * self._n_out + np.append(output, limits[:, 0]))

    def matrix(self, places: Indices) -> sp.csc_matrix:
        """Rows of limits at places, columns by knots but the first and generators."""
        new = np.array(sorted(set(places.tolist()) - self._in_set_points.keys()), dtype=int)
        if len(new):
            point, output = np.divmod(new, self._n_out)
            rows = self._model.output_rows(output, point)
            found = self._model.by_set_points(rows)[:, 1:].reshape(len(new), -1)
            found[np.abs(found) < ROUND_OFF] = 0.0
            self._in_set_points.update(zip(new.tolist(), found, strict=True))
        n_columns = self._model.p_gen[1:].size
        values = [self._in_set_points[place] for place in places.tolist()]
        return sp.csc_matrix(np.array(values).reshape(-1, n_columns))


class BasisByPlaces(NamedTuple):
    """Where a program ended, its last rows by their places: where one like it, with other rows, may start."""

    columns: NDArray[np.object_]
    rows: NDArray[np.object_]  # those that are no outputs'
    outputs: dict[int, object]

    @staticmethod
    def of(basis: Basis, places: Indices) -> BasisByPlaces:
        """Of a program whose last rows have these places."""
        rows, outputs = np.split(basis.rows, [len(basis.rows) - len(places)])
        return BasisByPlaces(basis.columns, rows, dict(zip(places.tolist(), outputs.tolist(), strict=True)))

    def start(self, places: Indices) -> Basis:
        """For a program whose last rows have these places."""
        outputs = np.empty(len(places), dtype=object)
        outputs[:] = [self.outputs.get(place) for place in places.tolist()]
        return Basis(self.columns, np.append(self.rows, outputs))


def pieces_of(model: TimeVarying) -> Indices:
    """First grid points of the pieces of Σ |P_s| at first, where its sign may change."""
    return divided(model.points, -(-model.lengths // PIECE))


#: Row numbers, column numbers and values of dense blocks, stacked or single.
Block = tuple[Indices, Indices, Array]


class KnotColumns:
    """Columns of an interval, one after another: s of its pieces, then u and x at its end.

    The first knot has none: P_0 and x_0 are given. An island has no s, and a condensed program no x. Other
    programs have x at some knots only: at the ends of stages of several intervals.

    Args:
        case: the grid.
        instance: costs and P_0.
        model: a linear model along a trajectory that starts at P_0.
        stage: how many intervals a stage has; 0: no x at all, states are substituted.
        pieces: first grid points of the pieces; None: one an interval if P_s keeps its sign, else see PIECE.
    """

    def __init__(
        self, case: Case, instance: Instance, model: TimeVarying, stage: int, pieces: Indices | None
    ) -> None:
        self._case, self._instance, self._model, self.stage = case, instance, model, stage
        self._n, self._n_gen = len(model.lengths), len(case.generators)
        #: First grid points of the pieces of Σ |P_s|; every interval between knots has its own.
        self.pieces = np.empty(0, dtype=int)
        #: What s is no less than: P_s, -P_s, or both.
        self.signs: tuple[float, ...] = 1.0, -1.0
        if case.slack is not None:
            self.pieces, size = pieces_of(model) if pieces is None else pieces, np.abs(model.p_slack)
            if pieces is None and size.min() > STEADY * size.max():
                self.pieces, self.signs = model.points[:-1], (float(np.sign(model.p_slack[0])),)
        first = np.searchsorted(self.pieces, model.points[:-1])
        owner = np.searchsorted(model.points[:-1], self.pieces, side="right") - 1
        own = np.append(first[1:], len(self.pieces))  # columns s up to the end of an interval
        knots, n_state = np.arange(self._n + 1), model.slack.shape[1]
        #: Of each knot, the last one up to it that has x, or whose x is given.
        self._with_x = knots // stage * stage if stage else np.zeros_like(knots)
        if stage:
            self._with_x[-1] = self._n
        #: Intervals at whose end there is x.
        self.ends = np.flatnonzero(self._with_x[1:] == knots[1:])
        before = self._n_gen * knots + n_state * np.searchsorted(self.ends, knots)  # columns of u and x
        self.s = np.arange(len(self.pieces)) + before[owner]
        power = (own + before[:-1])[:, None]
        self.u = power + np.arange(self._n_gen)
        self.x = power[self.ends] + self._n_gen + np.arange(n_state)  # (n_ends, n_state)
        self.last = own + before[1:] - 1  # of each interval
        self.count = len(self.pieces) + int(before[-1])
        self._durations = model.lengths * instance.dt_s
        self.slack_price = instance.cost_slack(case)
        self.generation = knot_weights(model.lengths)[:, None] * instance.cost_gen(case)
        self.cost = self._cost_of_all()

    def program(self, radius: float) -> FreeForm:
        """The program without limits of outputs, in which no set-point moves by more than the radius, pu."""
        case, model = self._case, self._model
        ramp = np.diff(model.p_gen, axis=0) / self._durations[:, None]
        slack = np.outer(self.signs, np.add.reduceat(model.p_slack, self.pieces)).ravel()
        p_min, p_max = power_limits(case, self._instance, model.lengths)
        transfers, room = self._transfers()
        lower, upper = np.full((2, self.count), np.inf) * [[-1.0], [1.0]]
        lower[self.s] = 0.0
        lower[self.u] = np.maximum(p_min - model.p_gen[1:], -radius)
        upper[self.u] = np.minimum(p_max - model.p_gen[1:], radius)
        return FreeForm(
            cost=self.cost,
            equal=self._dynamics,
            right=np.zeros(self.x.size),
            between=sp.csc_matrix(sp.vstack([self._ramps(), self._slack_sums, transfers])),
            low=np.concatenate([(-case.ramp - ramp).ravel(), np.full(len(slack) + room.size, -np.inf)]),
            high=np.concatenate([(case.ramp - ramp).ravel(), -slack, room]),
            lower=lower,
            upper=upper,
        )

    def local(self, rows: LocalRows, place: Indices, sign: float = 1.0) -> list[Block]:
        """Rows of intervals as blocks of one row each; the first knot has no columns."""
        in_state, in_set_points = self._model.carried_back(rows, self._with_x)
        begin = self._with_x[rows.interval]
        interval = begin[:, None] + np.arange(in_set_points.shape[1]) - 1  # at whose end u is
        in_set_points[(interval < 0) | (interval >= self._n)] = 0.0
        columns = self.u[interval.clip(0, self._n - 1)]
        later = begin > 0
        x = self.x[np.searchsorted(self.ends, begin[later] - 1)]
        return [
            (place[:, None, None], columns, sign * in_set_points[:, :, None]),
            (place[later, None], x, sign * in_state[later, None]),
        ]

    def matrix(self, n_rows: int, blocks: list[Block]) -> sp.csc_matrix:
        """Rows of dense blocks in all columns."""
        if not blocks:
            return sp.csc_matrix((n_rows, self.count))
        rows = [np.broadcast_to(row[..., :, None], value.shape).ravel() for row, _, value in blocks]
        columns = [np.broadcast_to(column[..., None, :], value.shape).ravel() for _, column, value in blocks]
        values = np.concatenate([value.ravel() for _, _, value in blocks])
        kept = np.abs(values) > ROUND_OFF
        place = np.concatenate(rows)[kept], np.concatenate(columns)[kept]
        return sp.csc_matrix((values[kept], place), (n_rows, self.count))

    def _cost_of_all(self) -> Array:
        """Cost of all columns: of what generators deliver, and of |P_s|."""
        cost = np.zeros(self.count)
        cost[self.s] = self.slack_price
        if self._model.delivered is None:
            cost[self.u] = self.generation[1:]
            return cost
        rows = self._model.cost_rows(self._instance.cost_gen(self._case))
        interval = np.arange(self._n)
        return cost + np.asarray(self.matrix(self._n, self.local(rows, interval)).sum(axis=0)).ravel()

    @functools.cached_property
    def _dynamics(self) -> sp.csc_matrix:
        across, ends, n_state = self._model.across, self.ends, self.x.shape[1]
        end = across.h / self._model.lengths[:, None, None]
        parts = (part[ends].reshape(-1, part.shape[2]) for part in (across.f, across.g - end, end))
        place = np.arange(self.x.size)
        blocks = self.local(LocalRows(np.repeat(ends, n_state), *parts), place, -1.0)
        one = place[:, None], self.x.reshape(-1, 1), np.ones((len(place), 1, 1))
        return self.matrix(len(place), [*blocks, one])

    def _ramps(self) -> sp.csc_matrix:
        """Ramps in pu/s: what the solver leaves open is as little in a short interval as in a long one."""
        row = np.arange(self.u.size).reshape(self._n, -1)
        one = np.eye(self._n_gen) / self._durations[:, None, None]
        return self.matrix(row.size, [(row, self.u, one), (row[1:], self.u[:-1], -one[1:])])

    def _transfers(self) -> tuple[sp.csc_matrix, Array]:
        """What the machines of each transfer deliver at all knots but the first, and how far it may go up."""
        by_machine = self._case.transfer_rows[0]
        if not len(by_machine):
            return self.matrix(0, []), np.empty(0)
        room = transfer_room(self._case, self._instance, self._model.points)
        row = np.arange(room.size).reshape(room.shape)
        blocks = [(row, self.u, np.broadcast_to(by_machine, (self._n, *by_machine.shape)))]
        return self.matrix(room.size, blocks), (room - self._model.p_gen[1:] @ by_machine.T).ravel()

    @functools.cached_property
    def _slack_sums(self) -> sp.csc_matrix:
        """Σ δP_s - s over every piece, or -Σ δP_s - s."""
        n = len(self.pieces)
        if not n:
            return self.matrix(0, [])
        rows, blocks = self._model.slack_rows(self.pieces), []
        for number, sign in enumerate(self.signs):
            place = np.arange(n) + n * number
            blocks += self.local(rows, place, sign)
            blocks += [(place[:, None], self.s[:, None], -np.ones((n, 1, 1)))]
        return self.matrix(n * len(self.signs), blocks)
