"""HiGHS: its dual simplex method on a Pyomo model, and on a linear program given by its arrays."""

from __future__ import annotations

import time
from typing import Any

import highspy
import numpy as np
import pyomo.environ as pyo
import scipy.sparse as sp

from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, assign, read_linear
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


def solve_form(form: FreeForm, time_limit_s: float = np.inf) -> FormAnswer:
    """Solve a linear program given by its arrays."""
    highs = _highs(_HIGHS_OPTIONS)
    rows = sp.csc_matrix(sp.vstack([form.equal, form.between]))
    highs.passModel(_highs_program(rows, np.append(form.right, form.low), np.append(form.right, form.high)))
    every = np.arange(len(form.cost), dtype=np.int32)
    highs.changeColsBounds(len(every), every, form.lower, form.upper)
    highs.changeColsCost(len(every), every, form.cost)
    highs.setOptionValue("time_limit", float(time_limit_s))
    highs.run()
    found, iterations = highs.getModelStatus(), int(highs.getInfo().simplex_iteration_count)
    status, x = _HIGHS_STATUS.get(found, Status.FAILED), np.array(highs.getSolution().col_value)
    return FormAnswer(status, x, iterations, f"highs {highs.version()}", highs.modelStatusToString(found))
