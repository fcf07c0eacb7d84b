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
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ded_bench.plants.hold import Hold, Indices, Sums, doubled
from ded_bench.problem.case import Array


class LocalRows(NamedTuple):
    """Rows in the variables of one interval each: x and u at its start, u at its end."""

    interval: Indices  # (n_rows,)
    x: Array  # (n_rows, n_state)
    start: Array  # (n_rows, n_gen)
    end: Array  # (n_rows, n_gen)

    def take(self, interval: Indices, slot: Indices) -> LocalRows:
        """Chosen rows of several in each interval, by interval and place."""
        chosen = interval, slot
        return LocalRows(interval, self.x[chosen], self.start[chosen], self.end[chosen])


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
        return self.powers or doubled(self.step, self.lengths)

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
        from ded_bench.plants.march import march  # and with it Numba

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

    def before_reset(self, rows: Array, intervals: Indices) -> Array:
        """Rows in the state after the start of intervals, (n, ..., n_state), as rows in that before it."""
        if self.reset is not None:
            begun, rows = np.isin(intervals, self.reset.intervals), rows.copy()
            rows[begun] = rows[begun] @ self.reset.f
        return rows

    @property
    def _intervals(self) -> Indices:
        """In which interval each grid point lies; the point at a knot belongs to the one after it."""
        owner = np.repeat(np.arange(len(self.lengths)), self.lengths)
        return np.append(owner, owner[-1])

    def frequency_rows(self, generators: Indices, points: Indices) -> LocalRows:
        """δω at single grid points, as rows in the variables of the intervals that they lie in.

        Args:
            generators: of which generator each row is, shape (n_rows,).
            points: at which grid point, none of them the first, shape (n_rows,).
        """
        interval = np.searchsorted(self.points, points) - 1
        steps, slot = points - self.points[interval], _places(interval)
        chosen, place = np.unique(interval, return_inverse=True)

        def add(r: int, costate: Array) -> None:
            here = np.flatnonzero(steps == r)
            costate[place[here], slot[here]] += self.output[generators[here]]

        rows = self._costates(int(slot.max(initial=-1)) + 1, add, chosen).take(place, slot)
        return rows._replace(interval=interval)

    def slack_rows(self, first: Indices) -> LocalRows:
        """Sums of δP_s over stretches of grid points, as rows in the variables of their intervals.

        Args:
            first: first grid point of each stretch, strictly increasing, shape (n_rows,); a stretch ends
                where the next one starts. All knots but the last start one: the last is the last stretch's.
        """
        interval = np.searchsorted(self.points[:-1], first, side="right") - 1
        ends, slot = np.append(first[1:], len(self.omega)), _places(interval)
        begin, end = first - self.points[interval], ends - self.points[interval]

        def add(r: int, costate: Array) -> None:
            here = np.flatnonzero((begin <= r) & (r < end))
            costate[interval[here], slot[here]] += self.slack[interval[here]]

        return self._costates(int(slot.max()) + 1, add).take(interval, slot)

    def cost_rows(self, cost: Array) -> LocalRows:
        """Sums of cost · δP, as delivered, over the grid points of every interval, a row for each.

        Args:
            cost: of the generators, shape (n_gen,).
        """
        assert self.delivered is not None  # else its caller has another way
        on_state, on_input = (np.einsum("g,jgi->ji", cost, part) for part in self.delivered[:2])

        length, count = self.lengths[:, None], self.lengths[:, None].copy()
        count[-1] += 1  # the point at a knot is of the interval after it, the last of the last one
        none = np.zeros_like(on_input)
        total, block = Sums(0.0 * on_state, none, none), Sums(on_state, none, none)
        # Blocks of 1, 2, 4, ... points, each before the shorter ones.
        for bit in range(int(count.max()).bit_length()):
            chosen, later, twice = (count >> bit & 1) == 1, total, block
            if bit < len(self.doubled):
                later, twice = (one.after(self.doubled[bit], 2**bit) for one in (total, block))
            total = Sums(
                *(np.where(chosen, b + t, old) for b, t, old in zip(block, later, total, strict=True))
            )
            block = Sums(*(b + t for b, t in zip(block, twice, strict=True)))
        # u rises linearly over an interval: Σ r / length over its points, of which the last has one more.
        risen = (count - 1.0) * count / 2.0 / length
        end = on_input * risen + total.slope / length
        start = on_input * count + total.u - end
        return LocalRows(np.arange(len(count)), self.before_reset(total.x, np.arange(len(count))), start, end)

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

        def add(r: int, costate: Array) -> None:
            here = np.flatnonzero(r < np.append(length[:-1], length[-1] + 1))
            costate[here, 0] += on_state[self.points[here] + r]

        rows = self._costates(1, add)
        later = ((np.arange(len(owner)) - self.points[owner]) / length[owner])[:, None]
        found = np.zeros_like(self.p_gen)
        np.add.at(found, owner, (1.0 - later) * on_input)
        np.add.at(found, owner + 1, later * on_input)
        costate = np.zeros(self.slack.shape[1])
        for j in reversed(range(len(length))):
            slope = costate @ self.across.h[j] / length[j]
            found[j + 1] += slope + rows.end[j, 0]
            found[j] += costate @ self.across.g[j] - slope + rows.start[j, 0]
            costate = costate @ self.across.f[j] + rows.x[j, 0]
        return found

    def by_set_points(self, rows: LocalRows) -> Array:
        """Rows in the variables of intervals as rows in the set-points alone: states are substituted.

        Every row is taken back through the intervals before its own, all rows of later intervals at once.

        Args:
            rows: in ascending order of intervals; interval n_intervals is the last knot, which has no end.

        Returns:
            Shape (n_rows, n_knots, n_gen).
        """
        found = np.zeros((len(rows.interval), *self.p_gen.shape))
        found[np.arange(len(found)), rows.interval] = rows.start
        has_end = np.flatnonzero(rows.interval < len(self.lengths))
        found[has_end, rows.interval[has_end] + 1] = rows.end[has_end]
        costate, at_end = rows.x.copy(), self.across.h / self.lengths[:, None, None]
        for j in range(len(self.lengths) - 1, -1, -1):
            later = slice(int(np.searchsorted(rows.interval, j, side="right")), None)
            end = costate[later] @ at_end[j]
            found[later, j + 1] += end
            found[later, j] += costate[later] @ self.across.g[j] - end
            costate[later] = costate[later] @ self.across.f[j]
        return found

    def _costates(
        self, n_rows: int, add: Callable[[int, Array], None], chosen: Indices | None = None
    ) -> LocalRows:
        """The adjoint recursion through all intervals, or some, at once, `n_rows` weighted sums in each.

        Args:
            n_rows: sums per interval.
            add: called with a number of steps r from the intervals' starts, and the costates there, shape
                (n_intervals, n_rows, n_state), to which it adds the weights of δx at that point.
            chosen: intervals, in ascending order.
        """
        chosen = np.arange(len(self.slack)) if chosen is None else chosen
        lengths = self.lengths[chosen]
        (n_state, n_gen), n = (self.slack.shape[1], self.p_gen.shape[1]), len(lengths)
        f, g, h = self.step if n == len(self.slack) else self.step.take(chosen)
        costate = np.zeros((n, n_rows, n_state))
        on_start, on_slope = np.zeros((2, n, n_rows, n_gen))
        for r in range(int(lengths.max(initial=0)), -1, -1):
            add(r, costate)
            if r:
                through = costate @ g
                on_start += through
                on_slope += (r - 1) * through + costate @ h
                costate = costate @ f
        costate = self.before_reset(costate, chosen)
        end = on_slope / lengths[:, None, None]
        return LocalRows(np.arange(n), costate, on_start - end, end)


def _places(interval: Indices) -> Indices:
    """How many earlier entries are equal, shape (n,)."""
    order = np.argsort(interval, kind="stable")
    ordered = interval[order]
    places = np.empty_like(interval)
    places[order] = np.arange(len(interval)) - np.searchsorted(ordered, ordered)
    return places
