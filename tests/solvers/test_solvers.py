"""Solvers: known optima, renewed numbers, honest statuses."""

from __future__ import annotations

import dataclasses

import highspy
import numpy as np
import pyomo.environ as pyo
import pytest
import scipy.sparse as sp

from ded_bench.solvers import highs, piqp
from ded_bench.solvers.compile import SOLVERS, OnArrays, fix
from ded_bench.solvers.ipopt import CasadiIpopt
from ded_bench.solvers.linear_program import FreeForm
from ded_bench.solvers.status import Status


def diet(prices: tuple[float, float] = (2.0, 3.0), need: float = 4.0) -> pyo.ConcreteModel:
    """Buy x, y >= 0 with x + 2 y >= need and x <= 3: prices and need are data."""
    m = pyo.ConcreteModel()
    m.price = pyo.Var([0, 1])
    m.need = pyo.Var()
    m.x = pyo.Var(bounds=(0, 3))
    m.y = pyo.Var(bounds=(0, None))
    m.enough = pyo.Constraint(expr=m.x + 2 * m.y - m.need >= 0)
    m.total = pyo.Objective(expr=m.price[0] * m.x + m.price[1] * m.y + 1)
    for i in (0, 1):
        fix(m.price[i], prices[i])
    fix(m.need, need)
    return m


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


def test_an_error_of_the_objective_saves_iterations() -> None:
    """And is not exceeded."""
    rough = piqp.solve_form(FORM, error=0.1)
    assert rough.status == Status.OPTIMAL
    assert rough.iterations < piqp.solve_form(FORM).iterations
    assert FORM.cost @ rough.x == pytest.approx(7.0, abs=0.1)


def test_what_round_off_spoils_is_solved_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of HiGHS's status `Unknown`: without presolve and scaled, the answer is the same."""
    told, first = highspy.Highs.getModelStatus, [highspy.HighsModelStatus.kUnknown]
    monkeypatch.setattr(highspy.Highs, "getModelStatus", lambda self: first.pop() if first else told(self))
    answer = highs.solve_form(FORM)
    assert (answer.status, answer.message, first) == (Status.OPTIMAL, "Optimal", [])
    np.testing.assert_allclose(answer.x, [2.0, 1.0], atol=1e-9)


def rosenbrock() -> pyo.ConcreteModel:
    m = pyo.ConcreteModel()
    m.x = pyo.Var(initialize=-1.2)
    m.y = pyo.Var(initialize=1.0)
    m.cost = pyo.Objective(expr=(1 - m.x) ** 2 + 100 * (m.y - m.x**2) ** 2)
    return m


def transport(size: int = 60) -> pyo.ConcreteModel:
    """A dense linear program that takes every solver more than a moment."""
    rng = np.random.default_rng(0)
    m = pyo.ConcreteModel()
    m.i = pyo.RangeSet(0, size - 1)
    m.x = pyo.Var(m.i, m.i, bounds=(0, None))
    cost = rng.random((size, size))
    m.supply = pyo.Constraint(m.i, rule=lambda m, i: sum(m.x[i, j] for j in m.i) <= 1.5)
    m.demand = pyo.Constraint(m.i, rule=lambda m, j: sum(m.x[i, j] for i in m.i) >= 1.0)
    m.total = pyo.Objective(expr=sum(cost[i, j] * m.x[i, j] for i in m.i for j in m.i))
    return m


@pytest.mark.parametrize("solver", SOLVERS)
def test_known_optima_before_and_after_new_numbers(solver: str) -> None:
    """Per unit of need, x costs its price and y half of it; then data and bounds change in place."""
    model = diet()
    compiled = OnArrays(model, solver)
    for prices, need, x, y in (((2.0, 3.0), 4.0, 0, 2), ((1.0, 3.0), 4.0, 3, 0.5), ((1.0, 3.0), 2.0, 2, 0)):
        for i in (0, 1):
            fix(model.price[i], prices[i])
        fix(model.need, need)
        outcome = compiled.solve()
        assert outcome.status == Status.OPTIMAL
        assert (model.x.value, model.y.value) == pytest.approx((x, y), abs=1e-6)
        assert outcome.objective == pytest.approx(prices[0] * x + prices[1] * y + 1, abs=1e-6)
        assert outcome.objective == pytest.approx(pyo.value(model.total), abs=1e-9)
        assert outcome.version.startswith(solver)
        assert outcome.setup_s >= 0 < outcome.solve_s


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_cannot_be_is_infeasible_and_what_has_no_end_fails(solver: str) -> None:
    model = diet()
    model.y.setub(0.25)
    outcome = OnArrays(model, solver).solve()
    assert outcome.status == Status.INFEASIBLE
    assert outcome.objective is None
    model = diet(prices=(2.0, -1.0))
    outcome = OnArrays(model, solver).solve()
    assert outcome.status == Status.FAILED
    assert outcome.message


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_time_limit_stops_one_solve_and_not_the_next(solver: str) -> None:
    model = transport()
    compiled = OnArrays(model, solver)
    whole = compiled.solve()
    assert whole.status == Status.OPTIMAL
    assert compiled.solve(1e-4).status == Status.TIME_LIMIT
    again = compiled.solve(60.0)
    assert again.status == Status.OPTIMAL
    assert again.objective == pytest.approx(whole.objective, rel=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
def test_linear_solvers_refuse_what_is_not_linear(solver: str) -> None:
    model = diet()
    model.curved = pyo.Constraint(expr=model.x**2 + model.y <= 9)
    with pytest.raises(ValueError, match="curved is not linear"):
        OnArrays(model, solver)
    model = diet()
    model.need.setub(None)
    model.total.expr += model.need * model.x
    with pytest.raises(ValueError, match="not linear in the free variables"):
        OnArrays(model, solver).solve()
    with pytest.raises(ValueError, match="not linear"):
        OnArrays(rosenbrock(), solver).solve()


def test_ipopt_solves_nonlinear_models() -> None:
    model = rosenbrock()
    outcome = CasadiIpopt(model).solve()
    assert outcome.status == Status.OPTIMAL
    assert outcome.iterations > 5
    assert (model.x.value, model.y.value) == pytest.approx((1.0, 1.0))
    model.x.setub(0.5)  # the valley's floor is y = x²
    outcome = CasadiIpopt(model).solve()
    assert outcome.objective == pytest.approx(0.25, abs=1e-6)
