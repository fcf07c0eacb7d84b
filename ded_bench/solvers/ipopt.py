"""IPOPT from the `casadi` wheel, which needs no installation."""

from __future__ import annotations

import functools
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
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, assign, bounds, told
from ded_bench.solvers.status import Outcome, Status

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
    """IPOPT and MUMPS from the `casadi` wheel on a Pyomo model's .nl form.

    Args:
        model: the Pyomo model; its structure must not change afterwards.
        options: IPOPT options beyond the defaults.
    """

    def __init__(self, model: pyo.ConcreteModel, options: dict[str, Any] | None = None) -> None:
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "model.nl")
            with path.open("w") as stream:
                info = NLWriter().write(model, stream, linear_presolve=False, symbolic_solver_labels=False)
            builder = casadi.NlpBuilder()
            builder.import_nl(str(path))
        nlp = {"x": casadi.vertcat(*builder.x), "f": builder.f, "g": casadi.vertcat(*builder.g)}
        self._columns = tuple(info.variables)
        self._rows = {"lbg": np.array(builder.g_lb), "ubg": np.array(builder.g_ub)}
        # Scalar expressions must be expanded, or every evaluation takes several times as long.
        self._made = functools.lru_cache(maxsize=1)(
            lambda limit: make_ipopt(nlp, options or {}, limit, {"expand": True})
        )
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """Solve for the current variable bounds and initial values.

        The first call also pays for set-up and symbolic derivatives.
        """
        started = time.perf_counter()
        solver = self._made(time_limit_s)
        lower, upper = bounds(self._columns)
        start = np.array([0.0 if v.value is None else v.value for v in self._columns])
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        arguments = {"x0": start, "lbx": lower, "ubx": upper, **self._rows}
        outcome, x = run_ipopt(solver, arguments, setup)
        if x is not None:
            assign(self._columns, x)
        return outcome


def solve_form(form: FreeForm, time_limit_s: float = np.inf) -> FormAnswer:
    """Solve a linear program; a time limit in s may be infinite."""
    (a, low, high), n = form.all_rows(), len(form.cost)
    x, pattern = casadi.MX.sym("x", n), casadi.Sparsity(*a.shape, a.indptr.tolist(), a.indices.tolist())
    g = casadi.mtimes(casadi.DM(pattern, a.data), x)
    limit = time_limit_s if np.isfinite(time_limit_s) else None
    solver = make_ipopt({"x": x, "f": casadi.dot(form.cost, x), "g": g}, LINEAR_OPTIONS, limit, {})
    arguments = {"x0": np.zeros(n), "lbx": form.lower, "ubx": form.upper, "lbg": low, "ubg": high}
    said, found = run_ipopt(solver, arguments, 0.0)
    x_or_zero = np.zeros(n) if found is None else found
    return told(form, FormAnswer(said.status, x_or_zero, said.iterations or 0, said.version, said.message))


def make_ipopt(
    nlp: dict[str, Any], ipopt: dict[str, Any], time_limit_s: float | None, options: dict[str, Any]
) -> casadi.Function:
    """IPOPT on a program; its own options, a time limit in s, and CasADi's options."""
    limit = {} if time_limit_s is None else {"max_wall_time": time_limit_s}
    ipopt = {"print_level": 0, "sb": "yes", **ipopt, **limit}
    options = {**options, "print_time": False, "error_on_fail": False, "ipopt": ipopt}
    return casadi.nlpsol("ipopt", "ipopt", nlp, options)


def run_ipopt(
    solver: casadi.Function, arguments: dict[str, Array], setup_s: float
) -> tuple[Outcome, Array | None]:
    """What IPOPT reports, and x if there is one."""
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
        x, objective = result["x"].full().ravel(), float(result["f"])
    said = None if error else stats.get("iter_count"), setup_s, elapsed, objective, _IPOPT_VERSION, message
    return Outcome(status, *said), x
