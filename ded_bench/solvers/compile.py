"""Solvers of Pyomo models by name: IPOPT, PIQP, HiGHS; see the modules of these names.

A Pyomo model is compiled once and solved many times: between solves only variable bounds and
initial values may change. What differs between instances is therefore written as variables fixed
by equal bounds, which the solvers remove before they start. Every solve starts cold: it never
depends on the ones before it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import pyomo.environ as pyo

from ded_bench.files.errors import InputError
from ded_bench.solvers import highs, piqp
from ded_bench.solvers.ipopt import LINEAR_OPTIONS, CasadiIpopt
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, assign, read_linear
from ded_bench.solvers.status import Compiled, Options, Outcome, Status


class OnArrays:
    """A linear Pyomo model for a solver of arrays; what PIQP does not solve, IPOPT decides."""

    def __init__(self, model: pyo.ConcreteModel, solve: Callable[[FreeForm, float], FormAnswer]) -> None:
        started = time.perf_counter()
        self._program, self._solve = read_linear(model), solve
        self._fallback: CasadiIpopt | None = None
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """See `Compiled`."""
        started = time.perf_counter()
        numbers = self._program.numbers()
        form = self._program.free_form(numbers)
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        started = time.perf_counter()
        answer = self._solve(form, np.inf if time_limit_s is None else time_limit_s)
        elapsed = time.perf_counter() - started
        objective = None
        if answer.status == Status.OPTIMAL:
            values = np.array(numbers.lower)
            values[numbers.free] = answer.x
            assign(self._program.columns, values)
            objective = self._program.objective(numbers, values)
        said = answer.iterations, setup, elapsed, objective, answer.version, answer.message
        outcome = Outcome(answer.status, answer.status == Status.OPTIMAL, *said)
        if answer.status != Status.FAILED or self._solve is not piqp.solve_form:
            return outcome
        rest = None if time_limit_s is None else max(time_limit_s - elapsed, 1e-3)  # IPOPT wants some
        self._fallback = self._fallback or CasadiIpopt(self._program, LINEAR_OPTIONS)
        verdict = self._fallback.solve(rest)
        return dataclasses.replace(
            verdict,
            setup_s=setup + verdict.setup_s,
            solve_s=elapsed + verdict.solve_s,
            version=f"{answer.version}, {verdict.version}",
            message=f"{answer.message}, {verdict.message}",
        )


#: Solvers by name; linear solvers take no options.
SOLVERS: dict[str, Callable[[pyo.ConcreteModel, Options | None], Compiled]] = {
    "ipopt": CasadiIpopt,
    "piqp": lambda model, _: OnArrays(model, piqp.solve_form),
    "highs": lambda model, _: OnArrays(model, highs.solve_form),
}


def compile_model(model: pyo.ConcreteModel, solver: str, options: Options | None = None) -> Compiled:
    """Compile a Pyomo model for a solver by name.

    Raises:
        InputError: unknown solver.
        ValueError: a linear solver is asked to solve a model that is not linear.
    """
    if solver not in SOLVERS:
        raise InputError("solver", solver, f"unknown (known: {', '.join(SOLVERS)})")
    return SOLVERS[solver](model, options)


def fix(variable: pyo.Var, value: float) -> None:
    """Make a variable data: fixed by equal bounds."""
    reset(variable, value, value, value)


def reset(variable: pyo.Var, value: float, lower: float | None = None, upper: float | None = None) -> None:
    """Set a variable's value and bounds."""
    variable.setlb(lower)
    variable.setub(upper)
    variable.set_value(value, skip_validation=True)
