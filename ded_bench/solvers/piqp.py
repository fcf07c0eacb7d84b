"""PIQP: a proximal interior-point method on sparse factors, here for linear programs."""

from __future__ import annotations

import dataclasses
import importlib
import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pyomo.environ as pyo
import scipy.sparse as sp

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Array
from ded_bench.solvers.ipopt import LINEAR_OPTIONS, CasadiIpopt
from ded_bench.solvers.linear_program import FreeForm, assign, read_linear
from ded_bench.solvers.outcome import Options, Outcome
from ded_bench.solvers.status import Status

#: On the 9-bus case PIQP takes 17 to 42 iterations.
_PIQP_OPTIONS: dict[str, Any] = {"max_iter": 100}


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
        self._fallback: CasadiIpopt | None = None
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
        self._fallback = self._fallback or CasadiIpopt(self._program, LINEAR_OPTIONS)
        verdict = self._fallback.solve(rest)
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
