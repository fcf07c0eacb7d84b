"""HiGHS: its dual simplex method on a linear program given by its arrays."""

from __future__ import annotations

from typing import Any

import highspy
import numpy as np

from ded_bench.solvers.linear_program import Basis, FormAnswer, FreeForm, told
from ded_bench.solvers.status import Status

_OPTIONS: dict[str, Any] = {
    "output_flag": False,
    "threads": 1,
    "solver": "simplex",
    "small_matrix_value": 1e-12,
    "primal_feasibility_tolerance": 1e-9,
    "simplex_scale_strategy": 0,  # columns are powers in pu as they are: a quarter less time on islands
}
#: For a program that round-off spoils: as it stands, and scaled. Of 2,495 programs of `ded-rti` on validation
#: draws of two-area-agc 15 were such; all of them have an optimum so, nine if merely begun anew.
_CAREFUL: dict[str, Any] = {"presolve": "off", "simplex_scale_strategy": 2}
_STATUS = {
    highspy.HighsModelStatus.kOptimal: Status.OPTIMAL,
    highspy.HighsModelStatus.kInfeasible: Status.INFEASIBLE,
    highspy.HighsModelStatus.kTimeLimit: Status.TIME_LIMIT,
}


def solve_form(form: FreeForm, time_limit_s: float = np.inf, start: Basis | None = None) -> FormAnswer:
    """Solve a linear program.

    Args:
        form: the program.
        time_limit_s: s; may be infinite.
        start: where to start: where a program ended that is like this one, but for rows that may be new.
    """
    highs = highspy.Highs()  # type: ignore[no-untyped-call]
    for name, value in (_OPTIONS | {"time_limit": float(time_limit_s)}).items():
        highs.setOptionValue(name, value)
    rows, low, high = form.all_rows()
    (n_rows, n_columns), least, by_column = rows.shape, 1, 1  # minimise; columns of a sparse matrix
    # Arrays as they are: HighsLp takes them number by number, a quarter of a solve on 39bus-agc.
    sizes, each = (n_columns, n_rows, rows.nnz), (form.cost, form.lower, form.upper, low, high)
    entries = rows.indptr, rows.indices, rows.data, np.zeros(n_columns, dtype=np.int32)  # all continuous
    arguments: tuple[Any, ...] = (*sizes, by_column, least, 0.0, *each, *entries)
    highs.passModel(*arguments)
    if start is not None:
        begun, basic = highspy.HighsBasis(), highspy.HighsBasisStatus.kBasic
        begun.col_status = start.columns.tolist()
        begun.row_status = [basic if mark is None else mark for mark in start.rows]
        begun.valid = begun.alien = True
        highs.setBasis(begun)
    highs.run()
    iterations = int(highs.getInfo().simplex_iteration_count)
    if (found := highs.getModelStatus()) not in _STATUS:
        highs.clearSolver()
        for name, value in _CAREFUL.items():
            highs.setOptionValue(name, value)
        highs.run()
        found, iterations = highs.getModelStatus(), iterations + int(highs.getInfo().simplex_iteration_count)
    status, x = _STATUS.get(found, Status.FAILED), np.array(highs.getSolution().col_value)
    ended = highs.getBasis()
    basis = Basis(np.array(ended.col_status, dtype=object), np.array(ended.row_status, dtype=object))
    message = highs.modelStatusToString(found)
    return told(form, FormAnswer(status, x, iterations, f"highs {highs.version()}", message, basis))
