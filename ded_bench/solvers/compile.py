"""Linear Pyomo models for solvers by name: IPOPT, PIQP, HiGHS; see the modules of these names.

A Pyomo model is read once and solved many times: between solves only variable bounds and values may change.
What differs between instances is therefore written as variables fixed by equal bounds, which are removed
before a solver sees the program. Every solve starts cold: it never depends on the ones before it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import pyomo.environ as pyo

from ded_bench.solvers import highs, ipopt, piqp
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, assign, read_linear
from ded_bench.solvers.status import Outcome, Status

#: Linear solvers by name.
SOLVERS: dict[str, Callable[[FreeForm, float], FormAnswer]] = {
    "piqp": piqp.solve_form,
    "ipopt": ipopt.solve_form,
    "highs": highs.solve_form,
}


class OnArrays:
    """A linear Pyomo model for a solver of arrays; what PIQP does not solve, IPOPT decides.

    Raises:
        ValueError: the model is not linear.
    """

    def __init__(self, model: pyo.ConcreteModel, solver: str) -> None:
        started = time.perf_counter()
        self._program, self._solver = read_linear(model), solver
        self._setup_s = time.perf_counter() - started

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """Solve for the current variable bounds; the first call pays for set-up.

        Raises:
            ValueError: two variables that are free multiply each other.
        """
        started = time.perf_counter()
        form, values, constant = self._program.now()
        setup = self._setup_s + time.perf_counter() - started
        self._setup_s = 0.0  # paid once, by the first solve
        started = time.perf_counter()
        left = np.inf if time_limit_s is None else time_limit_s
        answer = SOLVERS[self._solver](form, left)
        if answer.status == Status.FAILED and self._solver == "piqp":
            spent = time.perf_counter() - started
            other = ipopt.solve_form(form, max(left - spent, 1e-3))  # IPOPT wants some
            version, message = f"{answer.version}, {other.version}", f"{answer.message}, {other.message}"
            iterations = answer.iterations + other.iterations
            answer = dataclasses.replace(other, iterations=iterations, version=version, message=message)
        elapsed, objective = time.perf_counter() - started, None
        if answer.status in (Status.OPTIMAL, Status.FEASIBLE):
            values[np.isnan(values)] = answer.x
            assign(self._program.columns, values)
            objective = float(form.cost @ answer.x) + constant
        said = answer.iterations, setup, elapsed, objective, answer.version, answer.message
        return Outcome(answer.status, *said)


def fix(variable: pyo.Var, value: float) -> None:
    """Make a variable data: fixed by equal bounds."""
    variable.setlb(value)
    variable.setub(value)
    variable.set_value(value, skip_validation=True)
