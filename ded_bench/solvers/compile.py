"""Solvers of Pyomo models by name: IPOPT, PIQP, HiGHS; see the modules of these names.

A Pyomo model is compiled once and solved many times: between solves only variable bounds and
initial values may change. What differs between instances is therefore written as variables fixed
by equal bounds, which the solvers remove before they start. Every solve starts cold: it never
depends on the ones before it.
"""

from __future__ import annotations

from collections.abc import Callable

import pyomo.environ as pyo

from ded_bench.files.errors import InputError
from ded_bench.solvers.highs import Highs
from ded_bench.solvers.ipopt import CasadiIpopt, IpoptExecutable
from ded_bench.solvers.outcome import Compiled, Options
from ded_bench.solvers.piqp import Piqp

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


def fix(variable: pyo.Var, value: float) -> None:
    """Make a variable data: fixed by equal bounds."""
    reset(variable, value, value, value)


def reset(variable: pyo.Var, value: float, lower: float | None = None, upper: float | None = None) -> None:
    """Set a variable's value and bounds."""
    variable.setlb(lower)
    variable.setub(upper)
    variable.set_value(value, skip_validation=True)
