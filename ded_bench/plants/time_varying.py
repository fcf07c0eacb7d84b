"""Linear time-varying models along a trajectory, by the knots of the schedules that they answer to.

Deviations x of any plant's state from the trajectory, under an increment u of the set-points that is linear
between knots, go from grid point to grid point by a map that is the same throughout an interval between
knots (first-order hold):

    x⁺ = f x + g u + h Δu,    δω = C x,    δP_s = c x,    δP = C_p x + D_p u

with δP what is delivered, on plants where that differs from the set-points. A plant with control in discrete
time has x⁺ = R x at the start of some intervals, before all that. The loads are those of the
trajectory, so that they enter through it alone. A lifted model (`Koopman`) has the same form, the same for
all intervals, around its own rollout under any powers.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ded_bench.plants.hold import Hold, Sums, doubled
from ded_bench.problem.case import Array, Indices


class LocalRows(NamedTuple):
    """Rows in the variables of one interval each: x and u at its start, u at its end."""

    interval: Indices  # (n_rows,)
    x: Array  # (n_rows, n_state)
    start: Array  # (n_rows, n_gen)
    end: Array  # (n_rows, n_gen)


class Delivered(NamedTuple):
    """What generators deliver where that is not their set-points."""

    c: Array  # C_p, (n_intervals, n_gen, n_state)
    d: Array  # D_p, (n_intervals, n_gen, n_gen)
    p_gen: Array  # of the trajectory, (n_points, n_gen), pu


class Reset(NamedTuple):
    """x⁺ = R x at the start of some intervals; no output changes by it at once."""

    intervals: Indices
    f: Array  # R, (n_state, n_state)


@dataclass(frozen=True, eq=False)
class TimeVarying:
    """(ω, P_s) at all grid points as affine functions of set-points at the knots.

    Interval j lies between knots j and j + 1.
    """

    points: Indices  # (n_knots,): grid point of each knot
    step: Hold  # over one grid step, of each interval
    across: Hold  # over the whole of each interval, a reset at its start included
    speed: slice  # the entries δω of the state
    slack: Array  # (n_intervals, n_state): δP_s / δx
    omega: Array  # (n_points, n_gen): of the trajectory, rad/s; or outputs, (n_points, n_out)
    p_slack: Array  # (n_points,): of the trajectory, pu
    p_gen: Array  # (n_knots, n_gen): set-points of the trajectory, pu
    delivered: Delivered | None = None  # None: the set-points are delivered
    reset: Reset | None = None
    matrix: Array | None = None  # (n_out, n_gen): outputs by ω; None: ω
    powers: tuple[Hold, ...] = ()  # of the maps over one grid step, by `doubled`; none: not found yet

    def monitored(self, matrix: Array) -> TimeVarying:
        """The same model with outputs y = matrix @ ω in the place of ω, matrix of shape (n_out, n_gen)."""
        if np.array_equal(matrix, np.eye(matrix.shape[1])):
            return self
        return replace(self, matrix=matrix, omega=self.omega @ matrix.T)

    @functools.cached_property
    def output(self) -> Array:
        """C: rows of outputs, (n_out, n_state)."""
        rows = np.zeros((self.omega.shape[1], self.slack.shape[1]))
        rows[:, self.speed] = np.eye(len(rows)) if self.matrix is None else self.matrix
        return rows

    @property
    def lengths(self) -> Indices:
        """Grid steps of each interval, shape (n_intervals,)."""
        return np.diff(self.points)

    @functools.cached_property
    def doubled(self) -> tuple[Hold, ...]:
        """Maps over 1, 2, 4, ... grid steps, see `doubled`."""
        is_current = self.powers and self.powers[0] is self.step  # a changed copy has other maps
        return self.powers if is_current else doubled(self.step, self.lengths)

    def states(self, u: Array) -> Array:
        """Deviations x at the knots under input increments.

        Args:
            u: δP at the knots, shape (n_knots, n_gen), pu; or several, (n_knots, n_gen, n_columns).

        Returns:
            Shape (n_knots, n_state), or (n_knots, n_state, n_columns), zero at the first knot.
        """
        columns = u[:, :, None] if u.ndim == 2 else u
        slope = np.diff(columns, axis=0) / self.lengths[:, None, None]
        driven = self.across.g @ columns[:-1] + self.across.h @ slope
        driven = driven[..., 0] if u.ndim == 2 else driven
        x = np.zeros((len(self.points), *driven.shape[1:]))
        for j, (f, force) in enumerate(zip(self.across.f, driven, strict=True)):
            x[j + 1] = f @ x[j] + force
        return x

    def outputs(self, u: Array) -> tuple[Array, Array]:
        """ω, shape (n_points, n_gen) in rad/s, and P_s, shape (n_points,) in pu, at all grid points.

        Args:
            u: δP at the knots, shape (n_knots, n_gen), pu.
        """
        from ded_bench.problem.compiled import march  # and with it Numba

        x, length = self.states(u), self.lengths
        slope = np.diff(u, axis=0) / length[:, None]
        state, force = x[:-1], (self.step.g @ u[:-1, :, None] + self.step.h @ slope[:, :, None])[..., 0]
        growth = (self.step.g @ slope[:, :, None])[..., 0]
        deviation = np.zeros((len(self.omega), x.shape[1]))
        deviation[self.points] = x
        if self.reset is not None:
            state = state.copy()
            state[self.reset.intervals] = state[self.reset.intervals] @ self.reset.f.T
        which, f = np.arange(len(length)), self.step.f
        if f.strides[0] == 0:  # the same map in all intervals
            which, f = np.zeros_like(which), f[:1]
        march(np.ascontiguousarray(f), which, state, force, growth, self.points, deviation)
        p_slack = np.einsum("ki,ki->k", self.slack[self._intervals], deviation)
        change = deviation[:, self.speed]
        change = change if self.matrix is None else change @ self.matrix.T
        return self.omega + change, self.p_slack + p_slack

    @property
    def _intervals(self) -> Indices:
        """In which interval each grid point lies; the point at a knot belongs to the one after it."""
        owner = np.repeat(np.arange(len(self.lengths)), self.lengths)
        return np.append(owner, owner[-1])

    def output_rows(self, outputs: Indices, points: Indices) -> LocalRows:
        """Outputs at single grid points, as rows in the variables of the intervals that they lie in.

        Args:
            outputs: which one each row is, shape (n_rows,).
            points: at which grid point, shape (n_rows,). A knot's row is that of the interval after it; the
                last knot's has n_intervals for it, and no u.
        """
        interval = np.searchsorted(self.points, points, side="right") - 1
        rows = Sums.of(self.output[outputs], np.zeros((len(points), self.p_gen.shape[1])))
        return self._local(rows, interval, points - self.points[interval])

    def slack_rows(self, first: Indices) -> LocalRows:
        """Sums of δP_s over stretches of grid points, as rows in the variables of their intervals.

        Args:
            first: first grid point of each stretch, strictly increasing, shape (n_rows,); a stretch ends
                where the next one starts. All knots but the last start one: the last is the last stretch's.
        """
        interval = np.searchsorted(self.points[:-1], first, side="right") - 1
        point = Sums.of(self.slack[interval], np.zeros((len(first), self.p_gen.shape[1])))
        rows = self._summed(point, interval, np.diff(np.append(first, len(self.omega))))
        return self._local(rows, interval, first - self.points[interval])

    def cost_rows(self, cost: Array) -> LocalRows:
        """Sums of cost · δP, as delivered, over the grid points of every interval, a row for each.

        Args:
            cost: of the generators, shape (n_gen,).
        """
        assert self.delivered is not None  # else its caller has another way
        point = Sums.of(*(np.einsum("g,jgi->ji", cost, part) for part in self.delivered[:2]))
        interval, counts = np.arange(len(self.lengths)), self.lengths.copy()
        counts[-1] += 1  # the point at a knot is of the interval after it, the last of the last one
        return self._local(self._summed(point, interval, counts), interval, np.zeros_like(counts))

    def _summed(self, block: Sums, interval: Indices, counts: Indices) -> Sums:
        """Rows of single points, which are changed, summed over so many of them: by blocks of 1, 2, 4, ..."""
        total = Sums(*(np.zeros_like(part) for part in block))
        for bit in range(int(counts.max()).bit_length()):
            here = np.flatnonzero(counts >> bit & 1)  # a block comes before the shorter ones
            later = self._earlier(total.take(here), interval[here], bit)
            for whole, one, rest in zip(total, block, later, strict=True):
                whole[here] = one[here] + rest
            here = np.flatnonzero(counts >> bit + 1)
            later = self._earlier(block.take(here), interval[here], bit)
            for one, rest in zip(block, later, strict=True):
                one[here] += rest
        return total

    def _local(self, rows: Sums, interval: Indices, steps: Indices) -> LocalRows:
        """Rows in x, u and Δu so many steps after the start of their intervals, in these ones' variables."""
        for bit in range(len(self.doubled)):
            here = np.flatnonzero(steps >> bit & 1)
            for whole, part in zip(rows, self._earlier(rows.take(here), interval[here], bit), strict=True):
                whole[here] = part
        end = rows.slope / np.append(self.lengths, 1)[interval, None]
        x = rows.x
        if self.reset is not None:  # rows in the state before it
            begun, x = np.isin(interval, self.reset.intervals), x.copy()
            x[begun] = x[begun] @ self.reset.f
        return LocalRows(interval, x, rows.u - end, end)

    def _earlier(self, rows: Sums, interval: Indices, bit: int) -> Sums:
        """Rows as those in x, u and Δu 2**bit grid steps earlier, all of an interval at once."""
        if bit == len(self.doubled):  # no interval is as long: there are none, or sums of no points
            return rows
        chosen, place = np.unique(interval, return_inverse=True)
        slot = _places(interval)
        shape = len(chosen), int(slot.max(initial=-1)) + 1
        together = Sums(*(np.zeros((*shape, part.shape[1])) for part in rows))
        for whole, part in zip(together, rows, strict=True):
            whole[place, slot] = part
        moved = together.after(self.doubled[bit].take(chosen), 2**bit)
        return Sums(*(part[place, slot] for part in moved))

    def gradient(self, by_omega: Array, by_p_slack: Array, by_p_gen: Array) -> Array:
        """Derivatives of any function of the outputs by the set-points at the knots, by the adjoint.

        Args:
            by_omega: its derivatives by ω at all grid points, shape (n_points, n_gen).
            by_p_slack: by P_s, shape (n_points,).
            by_p_gen: by what generators deliver, shape (n_points, n_gen).

        Returns:
            Shape (n_knots, n_gen).
        """
        length, owner = self.lengths, self._intervals
        on_state, on_input = by_p_slack[:, None] * self.slack[owner], by_p_gen.copy()
        on_state[:, self.speed] += by_omega if self.matrix is None else by_omega @ self.matrix
        if self.delivered is not None:
            for j, k in enumerate(map(slice, self.points[:-1], [*self.points[1:-1], len(owner)])):
                on_state[k] += by_p_gen[k] @ self.delivered.c[j]
                on_input[k] = by_p_gen[k] @ self.delivered.d[j]

        rows = Sums.of(np.zeros_like(self.slack)[:, None], np.zeros((len(length), 1, self.p_gen.shape[1])))
        for r in range(int(length.max()), -1, -1):
            here = np.flatnonzero(r < np.append(length[:-1], length[-1] + 1))
            rows.x[here, 0] += on_state[self.points[here] + r]
            rows = rows.after(self.step, 1) if r else rows
        local = self._local(Sums(*(part[:, 0] for part in rows)), np.arange(len(length)), 0 * length)
        later = ((np.arange(len(owner)) - self.points[owner]) / length[owner])[:, None]
        found = np.zeros_like(self.p_gen)
        np.add.at(found, owner, (1.0 - later) * on_input)
        np.add.at(found, owner + 1, later * on_input)
        costate = np.zeros(self.slack.shape[1])
        for j in reversed(range(len(length))):
            slope = costate @ self.across.h[j] / length[j]
            found[j + 1] += slope + local.end[j]
            found[j] += costate @ self.across.g[j] - slope + local.start[j]
            costate = costate @ self.across.f[j] + local.x[j]
        return found

    def by_set_points(self, rows: LocalRows) -> Array:
        """Rows in the variables of intervals as rows in the set-points alone: states are substituted.

        Args:
            rows: interval n_intervals is the last knot, which has no end.

        Returns:
            Shape (n_rows, n_knots, n_gen).
        """
        return self.carried_back(rows, np.zeros(len(self.points), dtype=int))[1]

    def carried_back(self, rows: LocalRows, first: Indices) -> tuple[Array, Array]:
        """Rows in the variables of intervals as rows in x at an earlier knot and in u since then.

        Every row is taken back through the intervals before its own, all rows of later intervals at once.

        Args:
            rows: interval n_intervals is the last knot, which has no end.
            first: the knot to go back to from each knot, no later than it, and the same from all between
                the two, (n_knots,).

        Returns:
            Rows in x there, (n_rows, n_state), and in u there and at the next knots, (n_rows, most, n_gen).
        """
        n, knots = len(self.lengths), np.arange(len(self.points))
        order = np.argsort(rows.interval, kind="stable")
        interval, costate = rows.interval[order], rows.x[order]
        begin, has_end = first[interval], np.flatnonzero(interval < n)
        most = max(int((knots - first)[:-1].max()) + 2, n - int(first[-1]) + 1)
        found = np.zeros((len(order), most, self.p_gen.shape[1]))
        found[np.arange(len(order)), interval - begin] = rows.start[order]
        found[has_end, (interval - begin)[has_end] + 1] = rows.end[order][has_end]
        at_end = self.across.h / self.lengths[:, None, None]
        later, until = (np.searchsorted(values, knots[:-1], side="right") for values in (interval, begin))
        for j in np.flatnonzero(later < until)[::-1]:
            here, place = slice(later[j], until[j]), j - first[j]
            end = costate[here] @ at_end[j]
            found[here, place + 1] += end
            found[here, place] += costate[here] @ self.across.g[j] - end
            costate[here] = costate[here] @ self.across.f[j]
        back = np.argsort(order)
        return costate[back], found[back]


def _places(interval: Indices) -> Indices:
    """How many earlier entries are equal, shape (n,)."""
    order = np.argsort(interval, kind="stable")
    ordered = interval[order]
    places = np.empty_like(interval)
    places[order] = np.arange(len(interval)) - np.searchsorted(ordered, ordered)
    return places
