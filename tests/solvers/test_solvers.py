"""Solvers: known optima, renewed numbers, honest statuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyomo.environ as pyo
import pytest
import scipy.sparse as sp

from ded_bench.solvers import highs, piqp
from ded_bench.solvers.ipopt import CasadiIpopt, fix
from ded_bench.solvers.linear_program import FreeForm
from ded_bench.solvers.status import Status

#: Minimise 2 x + 3 y with x + 2 y = 4, 1 <= x - y and 0 <= x, y <= 3: x = 2, y = 1.
FORM = FreeForm(
    cost=np.array([2.0, 3.0]),
    equal=sp.csc_matrix([[1.0, 2.0]]),
    right=np.array([4.0]),
    between=sp.csc_matrix([[1.0, -1.0]]),
    low=np.array([1.0]),
    high=np.array([np.inf]),
    lower=np.zeros(2),
    upper=np.full(2, 3.0),
)


@pytest.mark.parametrize(
    "solve", [piqp.solve_form, lambda form: piqp.solve_form(form, staged=True), highs.solve_form]
)
def test_programs_given_by_arrays(solve) -> None:
    """The known optimum; nothing is claimed of what has no solution."""
    answer = solve(FORM)
    assert answer.status == Status.OPTIMAL
    assert answer.x == pytest.approx([2.0, 1.0], abs=1e-6)
    assert answer.iterations >= 0
    assert answer.version.split()[0] in ("piqp", "highs")
    impossible = solve(dataclasses.replace(FORM, low=np.array([5.0])))
    assert impossible.status in (Status.INFEASIBLE, Status.FAILED)
    assert impossible.message


def rosenbrock() -> pyo.ConcreteModel:
    m = pyo.ConcreteModel()
    m.x = pyo.Var(initialize=-1.2)
    m.y = pyo.Var(initialize=1.0)
    m.cost = pyo.Objective(expr=(1 - m.x) ** 2 + 100 * (m.y - m.x**2) ** 2)
    return m


def test_ipopt_solves_pyomo_models_before_and_after_new_numbers() -> None:
    model = rosenbrock()
    compiled = CasadiIpopt(model)
    outcome = compiled.solve()
    assert outcome.status == Status.OPTIMAL
    assert outcome.iterations > 5
    assert outcome.version.startswith("ipopt")
    assert outcome.setup_s >= 0 < outcome.solve_s
    assert (model.x.value, model.y.value) == pytest.approx((1.0, 1.0))
    model.x.setub(0.5)  # the valley's floor is y = x²
    assert compiled.solve().objective == pytest.approx(0.25, abs=1e-6)
    model.x.set_value(-1.2)
    assert compiled.solve(1e-5).status == Status.TIME_LIMIT
    fix(model.x, -1.0)
    assert compiled.solve(60.0).objective == pytest.approx(4.0, abs=1e-6)


def test_what_cannot_be_is_infeasible_and_what_has_no_end_fails() -> None:
    model = rosenbrock()
    model.far = pyo.Constraint(expr=model.x**2 + model.y**2 <= -1)
    outcome = CasadiIpopt(model).solve()
    assert outcome.status == Status.INFEASIBLE
    assert not outcome.has_values
    assert outcome.objective is None
    model = pyo.ConcreteModel()
    model.x = pyo.Var(initialize=0.0)
    model.cost = pyo.Objective(expr=-model.x)
    outcome = CasadiIpopt(model).solve()
    assert outcome.status == Status.FAILED
    assert outcome.message
