"""Rows of outputs in the set-points alone, for condensed programs, and a simplex basis by them.

Every limit of an output has a place, by grid points.
"""

from __future__ import annotations

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
    """Rows of one model; those of an interval are found once, when one is asked for.

    Args:
        model: a linear model along a trajectory.
        speed: C of outputs, (n_intervals, n_out, n_state).
    """

    def __init__(self, model: TimeVarying, speed: Array) -> None:
        self._model, self._speed, self._n_out = model, speed, speed.shape[1]
        self._in_set_points: dict[int, Array] = {}
        self._known: dict[int, tuple[Array, Array, Array]] = {}

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

    def _local(self, places: Indices) -> LocalRows:
        """Rows in the variables of intervals; a knot's are those of the interval after it."""
        (point, output), model = np.divmod(places, self._n_out), self._model
        interval = np.searchsorted(model.points, point, side="right") - 1
        (n_state, n_gen), n = model.step.g.shape[1:], len(places)
        x, (start, end) = np.zeros((n, n_state)), np.zeros((2, n, n_gen))
        for i, (j, k, of) in enumerate(zip(interval.tolist(), point.tolist(), output.tolist(), strict=True)):
            if k == model.points[j]:
                x[i] = self._speed[min(j, len(self._speed) - 1), of]
            else:
                x[i], start[i], end[i] = (part[k - model.points[j] - 1, of] for part in self._inside(j))
        between = np.flatnonzero(point > model.points[interval])
        x[between] = model.before_reset(x[between], interval[between])
        return LocalRows(interval, x, start, end)

    def _inside(self, j: int) -> tuple[Array, Array, Array]:
        """Outputs at all points inside of an interval, (n_points, n_out, any), after a reset at its start.

        C times the map from its start, from grid point to grid point.
        """
        if j in self._known:
            return self._known[j]
        model, length = self._model, int(self._model.lengths[j])
        f, g, h = (part[j] for part in model.step)
        (n_state, n_gen), n = g.shape, length - 1
        x, (start, end) = np.empty((n, self._n_out, n_state)), np.empty((2, n, self._n_out, n_gen))
        costate, on_start, on_slope = self._speed[j], 0.0, 0.0
        for k in range(n):
            on_slope = on_slope + on_start + costate @ h
            on_start = on_start + costate @ g
            costate = costate @ f
            x[k], start[k], end[k] = costate, on_start - on_slope / length, on_slope / length
        self._known[j] = x, start, end
        return x, start, end


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
