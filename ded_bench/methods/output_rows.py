"""Rows of outputs in the set-points alone, for condensed programs, and a simplex basis by them.

Every limit of an output has a place: those at knots come first, by knots; those between knots follow, by grid
points.
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
    """Rows of one model; each is found once.

    Args:
        model: a linear model along a trajectory.
        at_knots: C of outputs at all knots but the first, (n_intervals, n_out, n_state).
    """

    def __init__(self, model: TimeVarying, at_knots: Array) -> None:
        self._model, self._at_knots = model, at_knots
        self._n_out = at_knots.shape[1]
        self._known: dict[int, Array] = {}

    def places(self, held: NDArray[np.bool_], limits: Indices) -> Indices:
        """Of limits at knots that are held, (n_intervals, n_out), and of (output, grid point) between."""
        between = held.size + limits[:, 1] * self._n_out + limits[:, 0]
        return np.append(np.flatnonzero(held), between)

    def matrix(self, places: Indices) -> sp.csc_matrix:
        """Rows of limits at places, columns by knots but the first and generators."""
        new, first = sorted(set(places.tolist()) - self._known.keys()), self._at_knots[..., 0].size
        for some, rows in (
            (np.array([place for place in new if place < first], dtype=int), self._knot_rows),
            (np.array([place for place in new if place >= first], dtype=int), self._rows_between),
        ):
            if len(some):
                found = self._model.by_set_points(rows(some))[:, 1:].reshape(len(some), -1)
                found[np.abs(found) < ROUND_OFF] = 0.0
                self._known.update(zip(some.tolist(), found, strict=True))
        n_columns = self._model.p_gen[1:].size
        values = np.array([self._known[place] for place in places.tolist()]).reshape(-1, n_columns)
        return sp.csc_matrix(values)

    def _knot_rows(self, places: Indices) -> LocalRows:
        knot, output = np.divmod(places, self._n_out)
        none = np.zeros((len(places), self._model.p_gen.shape[1]))
        return LocalRows(knot + 1, self._at_knots[knot, output], none, none)

    def _rows_between(self, places: Indices) -> LocalRows:
        point, output = np.divmod(places - self._at_knots[..., 0].size, self._n_out)
        return self._model.frequency_rows(output, point)


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
