"""IPOPT from the `casadi` wheel, which needs no installation."""

from __future__ import annotations

import importlib.metadata
import tempfile
import time
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pyomo.environ as pyo
from pyomo.repn.plugins.nl_writer import NLWriter

from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import LinearProgram, assign, bounds, read_linear
from ded_bench.solvers.status import Options, Outcome, Status

#: IPOPT's return values as CasADi spells them; everything else is a failure.
_IPOPT_STATUS = {
    "Solve_Succeeded": Status.OPTIMAL,
    "Solved_To_Acceptable_Level": Status.FEASIBLE,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
}
#: For linear programs: derivatives that never change, and bounds as they are (by default IPOPT relaxes
#: them by 1e-8). Mehrotra's steps would save a third, but with them IPOPT never says infeasible.
LINEAR_OPTIONS: dict[str, Any] = {
    "bound_relax_factor": 0.0,
    "grad_f_constant": "yes",
    "jac_c_constant": "yes",
    "jac_d_constant": "yes",
    "hessian_constant": "yes",
}
_IPOPT_VERSION = f"ipopt (casadi {importlib.metadata.version('casadi')})"


class CasadiIpopt:
    """IPOPT and MUMPS from the `casadi` wheel: on a linear model's arrays, else on its .nl form.

    Args:
        model: the Pyomo model, or its arrays; its structure must not change afterwards.
        options: IPOPT options beyond the defaults.
    """

    def __init__(self, model: pyo.ConcreteModel | LinearProgram, options: Options | None = None) -> None:
        started = time.perf_counter()
        self._options = dict(options or {})
        try:
            program = model if isinstance(model, LinearProgram) else read_linear(model)
            program.numbers()
            self._source: _Arrays | _Nl = _Arrays(program)
        except ValueError:  # not linear, or not until its data are fixed
            self._source = _Nl(model)
        self._solver: casadi.Function | None = None
        self._limit: float | None = None
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """See `Compiled`; the first call also pays for symbolic derivatives."""
        started = time.perf_counter()
        source = self._source
        if self._solver is None or self._limit != time_limit_s:
            self._solver, self._limit = self._make(time_limit_s), time_limit_s
        arguments, constant = source.current()
        start = np.array([0.0 if v.value is None else v.value for v in source.columns])
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        arguments |= {"x0": start, "lbg": source.g_lower, "ubg": source.g_upper}
        outcome, x = run_ipopt(self._solver, arguments, constant, setup)
        if x is not None:
            assign(source.columns, x)
        return outcome

    def _make(self, time_limit_s: float | None) -> casadi.Function:
        # Scalar expressions must be expanded, or every evaluation takes several times as long.
        options = {"expand": isinstance(self._source, _Nl)}
        return make_ipopt(self._source.nlp, self._options, time_limit_s, options)


def make_ipopt(
    nlp: dict[str, Any], ipopt: Options, time_limit_s: float | None, options: dict[str, Any]
) -> casadi.Function:
    """IPOPT on a program; its own options, a time limit in s, and CasADi's options."""
    limit = {} if time_limit_s is None else {"max_wall_time": time_limit_s}
    ipopt = {"print_level": 0, "sb": "yes", **ipopt, **limit}
    options = {**options, "print_time": False, "error_on_fail": False, "ipopt": ipopt}
    return casadi.nlpsol("ipopt", "ipopt", nlp, options)


def run_ipopt(
    solver: casadi.Function, arguments: dict[str, Array], constant: float, setup_s: float
) -> tuple[Outcome, Array | None]:
    """What IPOPT reports, and x if there is one; `constant` is what its objective leaves out."""
    started, error = time.perf_counter(), ""
    try:
        result = solver(**arguments)
    except RuntimeError as caught:  # of the library
        error = str(caught).splitlines()[0][:200]
    elapsed = time.perf_counter() - started
    stats = solver.stats()
    message = error or str(stats["return_status"])
    status = Status.FAILED if error else _IPOPT_STATUS.get(message, Status.FAILED)
    x = objective = None
    if status in (Status.OPTIMAL, Status.FEASIBLE, Status.TIME_LIMIT):
        x, objective = result["x"].full().ravel(), float(result["f"]) + constant
    said = stats.get("iter_count"), setup_s, elapsed, objective, _IPOPT_VERSION, message
    return Outcome(status, x is not None, *said), x


#: What IPOPT is called with, and what its objective leaves out.
_Current = tuple[dict[str, Array], float]


class _Arrays:
    """A linear program for CasADi: constant matrices, costs as parameters."""

    def __init__(self, program: LinearProgram) -> None:
        n_rows, n = program.a.shape
        pattern = casadi.Sparsity(n_rows, n, program.a.indptr.tolist(), program.a.indices.tolist())
        x, cost = casadi.MX.sym("x", n), casadi.MX.sym("cost", n)
        g = casadi.mtimes(casadi.DM(pattern, program.a.data), x)
        self.nlp: dict[str, Any] = {"x": x, "p": cost, "f": casadi.dot(cost, x), "g": g}
        self.columns = program.columns
        self.g_lower, self.g_upper = program.row_lower, program.row_upper
        self._program = program

    def current(self) -> _Current:
        numbers = self._program.numbers()
        arguments = {"lbx": numbers.lower, "ubx": numbers.upper, "p": numbers.cost}
        return arguments, numbers.constant


class _Nl:
    """A Pyomo model for CasADi through its .nl form."""

    def __init__(self, model: pyo.ConcreteModel) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "model.nl")
            with path.open("w") as stream:
                info = NLWriter().write(model, stream, linear_presolve=False, symbolic_solver_labels=False)
            builder = casadi.NlpBuilder()
            builder.import_nl(str(path))
        g = casadi.vertcat(*builder.g)
        self.nlp: dict[str, Any] = {"x": casadi.vertcat(*builder.x), "f": builder.f, "g": g}
        self.columns = tuple(info.variables)
        self.g_lower, self.g_upper = np.array(builder.g_lb), np.array(builder.g_ub)

    def current(self) -> _Current:
        lower, upper = bounds(self.columns)
        return {"lbx": lower, "ubx": upper}, 0.0
