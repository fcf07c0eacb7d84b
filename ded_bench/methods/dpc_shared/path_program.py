"""A linear program of corrections to a schedule, on the grid linearised along the schedule's path.

    min Σ c_i P_i + c_s |P_s|   subject to limits of |ω|, powers and ramps

Corrections are powers at every so-manieth knot, linear between. The states of the modes at the ends of the
intervals between them are variables, so that all blocks are small, and rows join neighbouring intervals only.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.methods.dpc_shared.grid_response import FINE
from ded_bench.methods.dpc_shared.path_model import Linear, Outset, PathModel
from ded_bench.methods.dpc_shared.stage_records import Indices
from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import FreeForm

#: Coefficients as small as this are left out: they are what a double leaves of zero.
ROUND_OFF = 1e-13
#: What an excess of |ω| as large as the bound, all through an interval, costs in a relaxed program, as a part
#: of what the schedule costs in that time.
WIDENING_PRICE = 2.0

#: Rows, and the limits between which they are kept.
Limited = tuple[sp.csc_matrix, Array, Array]


@dataclass(frozen=True, eq=False)
class IntervalMaps:
    """What happens in every interval, by column: the state at its start, corrections at its start and end.

    A state holds the modes, and their speeds after the second half of the kick (see `stage_kernels.swing`).
    """

    end: Array  # state at the end, (n_intervals, n_state, n_columns)
    omega: Array  # at the fine points after the start, (n_intervals, n_points, n_gen, n_columns)
    p_slack: Array  # there, (n_intervals, n_points, n_columns)

    @staticmethod
    def make(model: PathModel, linear: Linear, knots: int) -> IntervalMaps:
        """Advance unit columns through all intervals at once.

        Args:
            model: of the case.
            linear: of one problem.
            knots: in an interval; divides their number.
        """
        response, modes = model.response, model.modes
        (n, n_gen), points = response.shape.shape, knots * FINE
        count = (len(response.fine) - 1) // points
        change = np.tensordot(model.between, linear.change[0], axes=1)
        leverage = model.slack_stiffness(linear)[0] @ response.shape.T
        after = 1 + points * np.arange(count)[:, None] + np.arange(points)
        q, kicked = np.zeros((2, count, n, 2 * n + 2 * n_gen))
        q[:, :, :n], kicked[:, :, n : 2 * n] = np.eye(n), np.eye(n)
        start, end = np.zeros((2, n, q.shape[2]))
        start[:, 2 * n : 2 * n + n_gen] = end[:, 2 * n + n_gen :] = response.gain.T
        a = modes.step[:, :, :, None]
        omega, p_slack = np.empty((count, points, n_gen, q.shape[2])), np.empty((count, points, q.shape[2]))
        for i in range(points):
            before, now = (start + (end - start) * (place / points) for place in (i, i + 1))
            q, speed = (
                a[:, row, 0] * q + a[:, row, 1] * kicked + a[:, row, 2] * before + a[:, row, 3] * now
                for row in (0, 1)
            )
            kick = modes.half * (change[after[:, i]] @ q + modes.damping @ speed)
            speed -= kick
            kicked = speed - kick
            omega[:, i] = response.shape.T @ speed
            p_slack[:, i] = -(leverage[after[:, i], None] @ q)[:, 0]
        return IntervalMaps(np.concatenate([q, kicked], axis=1), omega, p_slack)


class PathProgram:
    """Programs around one schedule of one problem; they differ in where |ω| is limited."""

    def __init__(
        self, model: PathModel, outset: Outset, linear: Linear, powers: Array, knots: int, bound: float
    ) -> None:
        """Linearise and predict.

        Args:
            model: of the case.
            outset: of one problem.
            linear: along the path of `powers`.
            powers: at the knots, (1, n_knots, n_gen), pu.
            knots: from one correction to the next; divides the number of intervals between knots.
            bound: of |ω|, rad/s.
        """
        self._model, self._outset, self._linear = model, outset, linear
        self._powers, self._knots, self._bound = powers, knots, bound
        _, (omega,), (p_slack,) = model.respond(powers, outset, linear)
        self._omega = omega[1:].reshape(-1, knots * FINE, omega.shape[1])
        self._slack = p_slack[1:].reshape(-1, FINE).mean(axis=1)

    @functools.cached_property
    def _maps(self) -> IntervalMaps:
        return IntervalMaps.make(self._model, self._linear, self._knots)

    def near(self, part: float, powers: Array | None = None) -> NDArray[np.bool_]:
        """Where |ω| exceeds a part of the bound, (n_intervals, n_points, n_gen).

        Args:
            part: of the bound.
            powers: as predicted for other powers, (1, n_knots, n_gen), pu.
        """
        omega = self._omega
        if powers is not None:
            omega = self._model.respond(powers, self._outset, self._linear)[1][0, 1:].reshape(omega.shape)
        return np.asarray(np.abs(omega) > part * self._bound)

    def form(self, limited: NDArray[np.bool_], widened: bool = False) -> FreeForm:
        """The program by its arrays.

        Args:
            limited: where |ω| is limited, as `near` returns it.
            widened: every interval has a column by which its limits of |ω| are widened, for a price.
        """
        maps, (piece, widening, u, x) = self._maps, self.columns(widened)
        count, n_state, n_columns = maps.end.shape
        size = int(x[-1, -1]) + 1
        # of the columns of an interval's maps; the state and the correction at t = 0 are none
        place = np.full((count, n_columns), -1)
        place[1:, :n_state], place[1:, n_state : n_state + u.shape[1]] = x[:-1], u[:-1]
        place[:, n_state + u.shape[1] :] = u
        states = maps.end.reshape(-1, n_columns), place.repeat(n_state, axis=0)
        between, low, high = zip(
            self._ramp_rows(u, size),
            *self._slack_rows(place, piece, size),
            *self._frequency_rows(limited, place, widening, size),
            strict=True,
        )
        lower, upper = self._column_limits(piece, widening, u, size)
        return FreeForm(
            cost=self._cost(piece, widening, u, size),
            equal=_rows(size, states, _one(x, -1.0)),
            right=np.zeros(x.size),
            between=sp.csc_matrix(sp.vstack(between)),
            low=np.concatenate(low),
            high=np.concatenate(high),
            lower=lower,
            upper=upper,
        )

    def _ramp_rows(self, u: Indices, size: int) -> Limited:
        """What the schedule leaves of the ramps, in the steepest of each interval's knots."""
        before = np.vstack([np.full((1, u.shape[1]), -1), u[:-1]])
        rate = 1.0 / (self._knots * self._model.spacing)
        slope = np.diff(self._powers[0], axis=0).reshape(len(u), self._knots, -1) / self._model.spacing
        ramp = self._model.case.ramp
        lowest, highest = ramp + slope.min(axis=1), ramp - slope.max(axis=1)
        return _rows(size, _one(u, rate), _one(before, -rate)), -lowest.ravel(), highest.ravel()

    def _slack_rows(self, place: Indices, piece: Indices, size: int) -> list[Limited]:
        """The column of a piece is no less than |P_s| there, in the mean."""
        means = self._maps.p_slack.reshape(-1, FINE, place.shape[1]).mean(axis=1)
        at, below, none = place.repeat(self._knots, axis=0), _one(piece, -1.0), np.full(piece.size, -np.inf)
        return [
            (_rows(size, (means, at), below), none, -self._slack),
            (_rows(size, (-means, at), below), none, self._slack),
        ]

    def _frequency_rows(
        self, limited: NDArray[np.bool_], place: Indices, widening: Indices, size: int
    ) -> list[Limited]:
        interval, omega = limited.nonzero()[0], self._omega[limited]
        reach, at = self._maps.omega[limited], place[interval]
        if not widening.size:
            return [(_rows(size, (reach, at)), -self._bound - omega, self._bound - omega)]
        wide, none = _one(widening[interval], -1.0), np.full(omega.size, -np.inf)
        return [
            (_rows(size, (reach, at), wide), none, self._bound - omega),
            (_rows(size, (-reach, at), wide), none, self._bound + omega),
        ]

    def _cost(self, piece: Indices, widening: Indices, u: Indices, size: int) -> Array:
        """Sums over knots; a correction counts at all knots to both sides that it moves."""
        cost, prices = np.zeros(size), self._outset.problems.cost[0]
        hat = np.full((len(u), 1), float(self._knots))
        hat[-1] *= 0.5
        cost[u], cost[piece] = hat * prices[1:], prices[0]
        spent = self._powers[0].mean(axis=0) @ prices[1:] + prices[0] * np.abs(self._slack).mean()
        cost[widening] = WIDENING_PRICE * self._knots * max(float(spent), ROUND_OFF) / self._bound
        return cost

    def _column_limits(self, piece: Indices, widening: Indices, u: Indices, size: int) -> tuple[Array, Array]:
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        lower[piece] = lower[widening] = 0.0
        at, case = self._powers[0, self._knots :: self._knots], self._model.case
        lower[u], upper[u] = case.p_min - at, case.p_max - at
        return lower, upper

    def corrected(self, solution: Array, widened: bool = False) -> Array:
        """Powers with the corrections of a solution, (1, n_knots, n_gen), pu; limits hold nearly."""
        u = self.columns(widened)[2]
        at = np.concatenate([np.zeros((1, u.shape[1])), solution[u]])
        place = np.arange(self._powers.shape[1]) / self._knots
        low = np.minimum(place.astype(int), len(u) - 1)
        share = (place - low)[:, None]
        return np.asarray(self._powers + (1.0 - share) * at[low] + share * at[low + 1])

    def columns(self, widened: bool) -> tuple[Indices, Indices, Indices, Indices]:
        """Columns of |P_s| at each knot, of widenings, corrections and states, each (n_intervals, n)."""
        count, n_state, _ = self._maps.end.shape
        sizes = np.array([self._knots, int(widened), self._powers.shape[2], n_state])
        first = np.arange(count)[:, None] * sizes.sum()
        ends = sizes.cumsum()
        piece, widening, u, x = (first + np.arange(end - n, end) for n, end in zip(sizes, ends, strict=True))
        return piece, widening, u, x


def _rows(size: int, *parts: tuple[Array, Indices]) -> sp.csc_matrix:
    """Rows of so many columns from coefficients and their columns, each (n_rows, any number); -1 is none."""
    row = [np.broadcast_to(np.arange(len(v))[:, None], v.shape).ravel() for v, _ in parts]
    value, column = (np.concatenate([part[i].ravel() for part in parts]) for i in (0, 1))
    kept = (column >= 0) & (np.abs(value) > ROUND_OFF)
    at = np.concatenate(row)[kept], column[kept]
    return sp.csc_matrix((value[kept], at), (len(parts[0][0]), size))


def _one(columns: Indices, value: float) -> tuple[Array, Indices]:
    """One coefficient in each row."""
    return np.full((columns.size, 1), value), columns.reshape(-1, 1)
