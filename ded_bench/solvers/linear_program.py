"""A Pyomo model as the arrays of a linear program, read once and given new numbers for each solve.

What instances differ in are variable bounds, and variables fixed by equal bounds: such a variable
may multiply others in the objective, so that costs, too, can change from one solve to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pyomo.environ as pyo
import scipy.sparse as sp
from numpy.typing import NDArray
from pyomo.repn import generate_standard_repn

from ded_bench.problem.case import Array, Indices
from ded_bench.solvers.status import Status


@dataclass(frozen=True, eq=False)
class FreeForm:
    """One instance without its data: equal x = right, low <= between x <= high, lower <= x <= upper."""

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
        wider = replace(
            self,
            cost=np.insert(self.cost, after + 1, cost),
            equal=with_empty_columns(self.equal, after),
            between=with_empty_columns(self.between, after),
            lower=np.insert(self.lower, after + 1, lower),
            upper=np.insert(self.upper, after + 1, upper),
        )
        own = np.arange(len(self.cost))
        return wider, own + np.searchsorted(after, own), after + 1 + np.arange(len(after))

    def all_rows(self) -> tuple[sp.csc_matrix, Array, Array]:
        """A, low and high of low <= A x <= high, equalities first."""
        rows = sp.csc_matrix(sp.vstack([self.equal, self.between]))
        return rows, np.append(self.right, self.low), np.append(self.right, self.high)

    def with_rows(self, between: sp.csc_matrix, low: Array, high: Array) -> FreeForm:
        """The program with more rows low <= between x <= high."""
        rows = sp.csc_matrix(sp.vstack([self.between, between]))
        return replace(self, between=rows, low=np.append(self.low, low), high=np.append(self.high, high))


def with_empty_columns(matrix: sp.csc_matrix, after: Indices) -> sp.csc_matrix:
    """A matrix with an empty column after each of these."""
    starts = np.insert(matrix.indptr, after + 1, matrix.indptr[after + 1])
    return sp.csc_matrix((matrix.data, matrix.indices, starts), (matrix.shape[0], len(starts) - 1))


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
    reduced_cost: Array | None = None  # of all columns, where an interior-point method ended


#: Are told of every program that this process solves, and of the answer.
LISTENERS: list[Callable[[FreeForm, FormAnswer], None]] = []


def told(form: FreeForm, answer: FormAnswer) -> FormAnswer:
    """The answer, when listeners have heard of it."""
    for listener in LISTENERS:
        listener(form, answer)
    return answer


@dataclass(frozen=True, eq=False)
class LinearProgram:
    """row_lower <= a x <= row_upper, and an objective linear in x once the data are known."""

    columns: tuple[Any, ...]  # Pyomo variables
    a: sp.csc_matrix  # (n_rows, n_columns)
    row_lower: Array
    row_upper: Array
    linear: Array  # (n_columns,)
    bilinear: sp.csr_matrix  # (n_columns, n_columns), symmetric: objective ½ xᵀ Q x + linear·x
    constant: float

    def now(self) -> tuple[FreeForm, Array, float]:
        """The program under the current bounds of the Pyomo variables.

        Returns:
            The program of the free columns; values of all, not a number where they are free; and what its
            objective leaves out.

        Raises:
            ValueError: two variables that are free multiply each other.
        """
        lower, upper = bounds(self.columns)
        free = lower != upper
        data = np.where(free, 0.0, lower)
        if (self.bilinear @ free.astype(float))[free].any():
            raise ValueError("the objective is not linear in the free variables")
        slope, rows, shift = self.bilinear @ data, self.a.tocsr(), self.a @ data
        equal = self.row_lower == self.row_upper
        form = FreeForm(
            cost=(self.linear + slope)[free],
            equal=sp.csc_matrix(rows[equal][:, free]),
            right=(self.row_lower - shift)[equal],
            between=sp.csc_matrix(rows[~equal][:, free]),
            low=(self.row_lower - shift)[~equal],
            high=(self.row_upper - shift)[~equal],
            lower=lower[free],
            upper=upper[free],
        )
        constant = self.constant + float(data @ (self.linear + 0.5 * slope))
        return form, np.where(free, np.nan, data), constant


def bounds(columns: Sequence[Any]) -> Array:
    """Lower and upper bounds of Pyomo variables, shape (2, n); infinite where there are none."""
    both = np.array([[v.lb for v in columns], [v.ub for v in columns]], dtype=float)  # None becomes NaN
    return np.where(np.isnan(both), [[-np.inf], [np.inf]], both)


def assign(columns: Iterable[Any], values: Array) -> None:
    """Set the values of Pyomo variables."""
    for variable, value in zip(columns, values.tolist(), strict=True):
        variable.set_value(value, skip_validation=True)


def read_linear(model: pyo.ConcreteModel) -> LinearProgram:
    """Read a Pyomo model with linear constraints and one active objective, which is minimised.

    Raises:
        ValueError: a constraint is not linear, or the objective is of higher degree than two.
    """
    index: dict[int, int] = {}
    columns: list[Any] = []

    def column(variable: Any) -> int:
        known = index.setdefault(id(variable), len(columns))
        if known == len(columns):
            columns.append(variable)
        return known

    rows: list[int] = []
    cols: list[int] = []
    values: list[float] = []
    lower: list[float] = []
    upper: list[float] = []
    for constraint in model.component_data_objects(pyo.Constraint, active=True):
        low, body, high = constraint.to_bounded_expression(evaluate_bounds=True)
        repn = generate_standard_repn(body, quadratic=False)
        if repn.nonlinear_expr is not None:
            raise ValueError(f"constraint {constraint.name} is not linear")
        rows += [len(lower)] * len(repn.linear_vars)
        cols += [column(variable) for variable in repn.linear_vars]
        values += repn.linear_coefs
        lower.append(-np.inf if low is None else low - repn.constant)
        upper.append(np.inf if high is None else high - repn.constant)

    objective = next(model.component_data_objects(pyo.Objective, active=True))
    repn = generate_standard_repn(objective.expr, quadratic=True)
    if repn.nonlinear_expr is not None:
        raise ValueError("the objective is not linear in the free variables")
    pairs = np.array([(column(one), column(other)) for one, other in repn.quadratic_vars], dtype=int)
    places = [column(variable) for variable in repn.linear_vars]
    n = len(columns)
    linear = np.zeros(n)
    np.add.at(linear, places, repn.linear_coefs)
    half = sp.csr_matrix((repn.quadratic_coefs, pairs.reshape(-1, 2).T), shape=(n, n))
    return LinearProgram(
        columns=tuple(columns),
        a=sp.csc_matrix((values, (rows, cols)), shape=(len(lower), n)),
        row_lower=np.array(lower),
        row_upper=np.array(upper),
        linear=linear,
        bilinear=sp.csr_matrix(half + half.T),
        constant=float(repn.constant),
    )
