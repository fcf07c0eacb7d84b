"""Rows of outputs in the set-points alone, for condensed programs, and a simplex basis by them.

Every limit of an output has a place, by grid points.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.plants.time_varying import Indices, LocalRows, TimeVarying
from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import Basis

#: Entries of rows below this are left out: they are what a double leaves of zero.
ROUND_OFF = 1e-13


class OutputRows:
    """Rows of one model at all grid points, found once.

    Args:
        model: a linear model along a trajectory.
        speed: C of outputs, (n_intervals, n_out, n_state).
    """

    def __init__(self, model: TimeVarying, speed: Array) -> None:
        self._model, self._speed, self._n_out = model, speed, speed.shape[1]
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
            found = self._model.by_set_points(self._local(new))[:, 1:].reshape(len(new), -1)
            found[np.abs(found) < ROUND_OFF] = 0.0
            self._in_set_points.update(zip(new.tolist(), found, strict=True))
        n_columns = self._model.p_gen[1:].size
        values = [self._in_set_points[place] for place in places.tolist()]
        return sp.csc_matrix(np.array(values).reshape(-1, n_columns))

    def outputs(self, u: Array) -> Array:
        """Outputs at all grid points, (n_points, n_out), rad/s, under increments (n_knots, n_gen), pu."""
        model, at, found = self._model, self._at_points, self._model.omega.copy()
        for j, (x, first, last) in enumerate(
            zip(model.states(u), model.points, model.points[1:], strict=False)
        ):
            found[first] += at.x[first] @ x
            after = model.after_reset(x[None], np.array([j]))[0]
            between = slice(first + 1, last)
            found[between] += at.x[between] @ after + at.start[between] @ u[j] + at.end[between] @ u[j + 1]
        found[-1] += at.x[-1] @ model.states(u)[-1]
        return found

    def _local(self, places: Indices) -> LocalRows:
        """Rows in the variables of intervals; a knot's are those of the interval after it."""
        (point, output), model = np.divmod(places, self._n_out), self._model
        interval = np.searchsorted(model.points, point, side="right") - 1
        rows = LocalRows(interval, *(part[point, output] for part in self._at_points[1:]))
        between = np.flatnonzero(point > model.points[interval])
        rows.x[between] = model.before_reset(rows.x[between], interval[between])
        return rows

    @functools.cached_property
    def _at_points(self) -> LocalRows:
        """All outputs at all grid points, (n_points, n_out, any), as if no interval began with a reset.

        C times the map from an interval's start, from grid point to grid point.
        """
        model, (n_state, n_gen) = self._model, self._model.step.g.shape[1:]
        interval, length = np.arange(len(model.lengths)), model.lengths
        shape, owner = (len(model.omega), self._n_out), np.repeat(interval, length)
        x, start, end = np.zeros((*shape, n_state)), np.zeros((*shape, n_gen)), np.zeros((*shape, n_gen))
        x[-1] = self._speed[-1]
        costate, (f, g, h) = self._speed, model.step
        on_start = on_slope = np.zeros((len(interval), self._n_out, n_gen))
        for r in range(int(length.max())):
            if not (more := length[interval] > r).all():
                interval, costate = interval[more], costate[more]
                on_start, on_slope = on_start[more], on_slope[more]
                f, g, h = model.step.take(interval)
            point = model.points[interval] + r
            rise = on_slope / length[interval, None, None]
            x[point], start[point], end[point] = costate, on_start - rise, rise
            on_slope = on_slope + on_start + costate @ h
            on_start = on_start + costate @ g
            costate = costate @ f
        return LocalRows(np.append(owner, len(length)), x, start, end)


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
