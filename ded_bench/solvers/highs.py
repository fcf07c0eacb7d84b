"""HiGHS: its dual simplex method on a Pyomo model, and on a small program to which rows are added."""

from __future__ import annotations

import time
from typing import Any

import highspy
import numpy as np
import pyomo.environ as pyo
import scipy.sparse as sp

from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import assign, read_linear
from ded_bench.solvers.outcome import Options, Outcome
from ded_bench.solvers.status import Status

_HIGHS_OPTIONS: dict[str, Any] = {
    "output_flag": False,
    "threads": 1,
    "solver": "simplex",
    "small_matrix_value": 1e-12,
    "primal_feasibility_tolerance": 1e-9,
}
_HIGHS_STATUS = {
    highspy.HighsModelStatus.kOptimal: Status.OPTIMAL,
    highspy.HighsModelStatus.kInfeasible: Status.INFEASIBLE,
    highspy.HighsModelStatus.kTimeLimit: Status.TIME_LIMIT,
}


def _highs(options: Options) -> Any:
    highs = highspy.Highs()  # type: ignore[no-untyped-call]
    for name, value in options.items():
        if highs.setOptionValue(name, value) != highspy.HighsStatus.kOk:
            raise ValueError(f"HiGHS refuses the option {name} = {value!r}")
    return highs


def _highs_program(a: sp.csc_matrix, row_lower: Array, row_upper: Array) -> highspy.HighsLp:
    """Rows for HiGHS; columns get their numbers later."""
    program = highspy.HighsLp()
    program.num_row_, program.num_col_ = a.shape
    program.col_cost_ = program.col_lower_ = program.col_upper_ = np.zeros(a.shape[1])
    program.row_lower_, program.row_upper_ = row_lower, row_upper
    program.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    program.a_matrix_.start_, program.a_matrix_.index_ = a.indptr, a.indices
    program.a_matrix_.value_ = a.data
    return program


class Highs:
    """HiGHS on a linear program, by its dual simplex method unless options say otherwise."""

    def __init__(self, model: pyo.ConcreteModel, options: Options | None = None) -> None:
        started = time.perf_counter()
        self._program = program = read_linear(model)
        self._highs = _highs(_HIGHS_OPTIONS | dict(options or {}))
        self._highs.passModel(_highs_program(program.a, program.row_lower, program.row_upper))
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """See `Compiled`."""
        started = time.perf_counter()
        highs, numbers = self._highs, self._program.numbers()
        every = np.arange(len(numbers.cost), dtype=np.int32)
        highs.changeColsBounds(len(every), every, numbers.lower, numbers.upper)
        highs.changeColsCost(len(every), every, numbers.cost)
        highs.clearSolver()  # no basis of an earlier instance
        # HiGHS counts the time of all its runs.
        limit = np.inf if time_limit_s is None else highs.getRunTime() + time_limit_s
        highs.setOptionValue("time_limit", float(limit))
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        started = time.perf_counter()
        highs.run()
        elapsed = time.perf_counter() - started
        found, info = highs.getModelStatus(), highs.getInfo()
        status = _HIGHS_STATUS.get(found, Status.FAILED)
        has_values = status == Status.OPTIMAL
        objective = None
        if has_values:
            values = np.array(highs.getSolution().col_value)
            assign(self._program.columns, values)
            objective = self._program.objective(numbers, values)
        return Outcome(
            status,
            has_values,
            int(max(info.simplex_iteration_count, info.ipm_iteration_count, info.pdlp_iteration_count)),
            setup,
            elapsed,
            objective,
            f"highs {highs.version()}",
            highs.modelStatusToString(found),
        )


class GrowingProgram:
    """A small linear program in HiGHS whose first rows stay and to which others are added.

    Args:
        a: the rows that stay, shape (n_rows, n).
    """

    def __init__(self, a: sp.csr_matrix) -> None:
        self._n_rows, self._n = a.shape
        # Presolve costs more than it saves on a program that is solved again with a few more rows.
        self._highs = _highs(_HIGHS_OPTIONS | {"presolve": "off"})
        self._highs.passModel(_highs_program(sp.csc_matrix(a), np.zeros(a.shape[0]), np.zeros(a.shape[0])))
        self.version = f"highs {self._highs.version()}"

    def restart(self, cost: Array, lower: Array, upper: Array, row_lower: Array, row_upper: Array) -> None:
        """Set the numbers of columns and first rows; forget other rows and earlier solutions."""
        highs = self._highs
        columns, rows = (np.arange(n, dtype=np.int32) for n in (self._n, self._n_rows))
        if extra := highs.getNumRow() - self._n_rows:
            highs.deleteRows(extra, np.arange(self._n_rows, self._n_rows + extra, dtype=np.int32))
        highs.changeColsBounds(self._n, columns, lower, upper)
        highs.changeColsCost(self._n, columns, cost)
        highs.changeRowsBounds(self._n_rows, rows, row_lower, row_upper)
        highs.clearSolver()

    def add(self, rows: Array, lower: Array, upper: Array) -> None:
        """Add rows, shape (n_new, n), with lower <= rows @ x <= upper."""
        row, column = np.nonzero(rows)
        start = np.searchsorted(row, np.arange(len(rows)))
        values = rows[row, column]
        self._highs.addRows(len(rows), lower, upper, len(values), start, column, values)

    def solve(self, time_limit_s: float) -> tuple[Status, Array, int]:
        """Status, x and iterations, starting from the solution before the last rows were added."""
        highs = self._highs
        highs.setOptionValue("time_limit", highs.getRunTime() + time_limit_s)
        highs.run()
        status = _HIGHS_STATUS.get(highs.getModelStatus(), Status.FAILED)
        return status, np.array(highs.getSolution().col_value), int(highs.getInfo().simplex_iteration_count)
