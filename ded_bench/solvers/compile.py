"""The one place that chooses a solver and calls it: IPOPT (see `ipopt`), PIQP, HiGHS.

A Pyomo model is compiled once and solved many times: between solves only variable bounds and
initial values may change. What differs between instances is therefore written as variables fixed
by equal bounds, which the solvers remove before they start. Every solve starts cold: it never
depends on the ones before it.
"""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import highspy
import numpy as np
import pyomo.environ as pyo
import scipy.sparse as sp

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Array
from ded_bench.solvers.ipopt import LINEAR_OPTIONS, CasadiIpopt, IpoptExecutable
from ded_bench.solvers.linear_program import FreeForm, assign, read_linear
from ded_bench.solvers.outcome import Compiled, Options, Outcome
from ded_bench.solvers.status import Status

__all__ = [
    "SOLVERS",
    "Answer",
    "CasadiIpopt",
    "Compiled",
    "GrowingProgram",
    "Outcome",
    "compile_model",
    "fix",
    "reset",
    "solve_form",
]

#: On the 9-bus case PIQP takes 17 to 42 iterations.
_PIQP_OPTIONS: dict[str, Any] = {"max_iter": 100}
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


def fix(variable: pyo.Var, value: float) -> None:
    """Make a variable data: fixed by equal bounds."""
    reset(variable, value, value, value)


def reset(variable: pyo.Var, value: float, lower: float | None = None, upper: float | None = None) -> None:
    """Set a variable's value and bounds."""
    variable.setlb(lower)
    variable.setub(upper)
    variable.set_value(value, skip_validation=True)


class Piqp:
    """PIQP, a proximal interior-point method on sparse LDLᵀ factors, for linear programs.

    PIQP knows no clock: a time limit is turned into a number of iterations that fit into it. Nor does
    it tell well what is infeasible from what is hard: what it does not solve, IPOPT decides.

    Raises:
        InputError: the package `piqp` is not installed.
    """

    def __init__(self, model: pyo.ConcreteModel, options: Options | None = None) -> None:
        started = time.perf_counter()
        self._piqp = _piqp()
        self._options = _PIQP_OPTIONS | dict(options or {})
        self._program = read_linear(model)
        self._judge: CasadiIpopt | None = None
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """See `Compiled`."""
        started = time.perf_counter()
        numbers = self._program.numbers()
        solver = _piqp_loaded(self._program.free_form(numbers), self._options)
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        started = time.perf_counter()
        enough = int(solver.settings.max_iter)
        if time_limit_s is not None:
            solver.settings.max_iter = 1
            solver.solve()
            first = time.perf_counter() - started  # more than twice what another iteration takes
            solver.settings.max_iter = min(enough, max(1, int(2 * (time_limit_s / first - 1))))
        found = solver.solve()
        elapsed = time.perf_counter() - started
        version, iterations = f"piqp {self._piqp.__version__}", int(solver.result.info.iter)
        if found == self._piqp.PIQP_SOLVED:
            values = np.array(numbers.lower)
            values[numbers.free] = solver.result.x
            assign(self._program.columns, values)
            objective = self._program.objective(numbers, values)
            return Outcome(Status.OPTIMAL, True, iterations, setup, elapsed, objective, version, found.name)
        if found == self._piqp.PIQP_MAX_ITER_REACHED and solver.settings.max_iter < enough:
            return Outcome(Status.TIME_LIMIT, False, iterations, setup, elapsed, None, version, found.name)
        rest = None if time_limit_s is None else max(time_limit_s - elapsed, 1e-3)  # IPOPT wants some
        self._judge = self._judge or CasadiIpopt(self._program, LINEAR_OPTIONS)
        verdict = self._judge.solve(rest)
        return dataclasses.replace(
            verdict,
            setup_s=setup + verdict.setup_s,
            solve_s=elapsed + verdict.solve_s,
            version=f"{version}, {verdict.version}",
            message=f"{found.name}, {verdict.message}",
        )


def _piqp() -> ModuleType:
    try:
        return importlib.import_module("piqp")
    except ImportError:
        raise InputError("piqp", "", "not installed; `pip install piqp` or use other settings") from None


def _piqp_loaded(form: FreeForm, options: Options) -> Any:
    solver = _piqp().SparseSolver()
    for name, value in options.items():
        setattr(solver.settings, name, value)
    n = len(form.cost)
    solver.setup(
        sp.csc_matrix((n, n)),
        form.cost,
        form.equal,
        form.right,
        form.between,
        form.low,
        form.high,
        form.lower,
        form.upper,
    )
    return solver


@dataclass(frozen=True, eq=False)
class Answer:
    """What PIQP says to one linear program given by its arrays; no x if it did not solve it."""

    x: Array | None
    iterations: int
    version: str
    message: str


def solve_form(form: FreeForm) -> Answer:
    """Solve a linear program by PIQP.

    Raises:
        InputError: the package `piqp` is not installed.
    """
    piqp, solver = _piqp(), _piqp_loaded(form, _PIQP_OPTIONS)
    found = solver.solve()
    x = np.array(solver.result.x) if found == piqp.PIQP_SOLVED else None
    return Answer(x, int(solver.result.info.iter), f"piqp {piqp.__version__}", found.name)


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


#: Solvers by name. The name "ipopt" means IPOPT from the `casadi` wheel.
SOLVERS: dict[str, Callable[[pyo.ConcreteModel, Options | None], Compiled]] = {
    "ipopt": CasadiIpopt,
    "ipopt-executable": IpoptExecutable,
    "piqp": Piqp,
    "highs": Highs,
}


def compile_model(model: pyo.ConcreteModel, solver: str, options: Options | None = None) -> Compiled:
    """Compile a Pyomo model for a solver by name.

    Raises:
        InputError: unknown solver, or one that is not installed.
        ValueError: a linear solver is asked to solve a model that is not linear.
    """
    if solver not in SOLVERS:
        raise InputError("solver", solver, f"unknown (known: {', '.join(SOLVERS)})")
    return SOLVERS[solver](model, options)
