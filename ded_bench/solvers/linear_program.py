"""Linear programs as arrays: what is solved, what solvers say, and who is told of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class FreeForm:
    """Least cost x with equal x = right, low <= between x <= high, lower <= x <= upper."""

    cost: Array
    equal: sp.csc_matrix
    right: Array
    between: sp.csc_matrix
    low: Array
    high: Array
    lower: Array
    upper: Array

    def with_columns(
        self, after: Indices, cost: Array, lower: Array, upper: Array
    ) -> tuple[FreeForm, Indices, Indices]:
        """The program with new columns, which no row knows yet, among its own.

        Args:
            after: the column after which each stands, in ascending order, shape (n_new,).
            cost, lower, upper: theirs.

        Returns:
            The program; where the columns that were there stand now, and where the new ones.
        """
        n, n_new = len(self.cost), len(after)
        place = np.arange(n) + np.searchsorted(after, np.arange(n))
        new = after + 1 + np.arange(n_new)

        def joined(own: Array, added: Array) -> Array:
            values = np.empty(n + n_new)
            values[place], values[new] = own, added
            return values

        wider = FreeForm(
            cost=joined(self.cost, cost),
            equal=moved_columns(self.equal, place, n + n_new),
            right=self.right,
            between=moved_columns(self.between, place, n + n_new),
            low=self.low,
            high=self.high,
            lower=joined(self.lower, lower),
            upper=joined(self.upper, upper),
        )
        return wider, place, new

    def with_rows(self, between: sp.csc_matrix, low: Array, high: Array) -> FreeForm:
        """The program with more rows low <= between x <= high."""
        rows = sp.csc_matrix(sp.vstack([self.between, between]))
        return replace(self, between=rows, low=np.append(self.low, low), high=np.append(self.high, high))


def moved_columns(matrix: sp.csc_matrix, place: Indices, n_columns: int) -> sp.csc_matrix:
    """A matrix whose columns stand at these places among `n_columns`; the others are empty."""
    counts = np.zeros(n_columns + 1, dtype=matrix.indptr.dtype)
    counts[place + 1] = np.diff(matrix.indptr)
    return sp.csc_matrix((matrix.data, matrix.indices, np.cumsum(counts)), (matrix.shape[0], n_columns))


class Basis(NamedTuple):
    """Where a simplex method starts or ends, in the solver's own marks."""

    columns: NDArray[np.object_]
    rows: NDArray[np.object_]  # equalities first; None: basic


@dataclass(frozen=True, eq=False)
class FormAnswer:
    """What a solver says to one linear program; x is of use with status `Optimal` or `Feasible`."""

    status: Status
    x: Array
    iterations: int
    version: str
    message: str
    basis: Basis | None = None  # where a simplex method ended


#: Are told of every program that this process solves, and of the answer.
LISTENERS: list[Callable[[FreeForm, FormAnswer], None]] = []


def told(form: FreeForm, answer: FormAnswer) -> FormAnswer:
    """The answer, when listeners have heard of it."""
    for listener in LISTENERS:
        listener(form, answer)
    return answer
