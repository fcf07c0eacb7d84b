"""Solvers: known optima, renewed numbers, honest statuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyomo.environ as pyo
import pytest
import scipy.sparse as sp

from ded_bench.methods.ded_ko import SOLVERS
from ded_bench.solvers import piqp
from ded_bench.solvers.ipopt import CasadiIpopt
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


def buy(prices: tuple[float, float] = (2.0, 3.0), need: float = 4.0) -> FreeForm:
    """Buy x, y >= 0 with x + 2 y >= need and x <= 3."""
    return FreeForm(
        cost=np.array(prices),
        equal=sp.csc_matrix((0, 2)),
        right=np.zeros(0),
        between=sp.csc_matrix([[1.0, 2.0]]),
        low=np.array([need]),
        high=np.array([np.inf]),
        lower=np.zeros(2),
        upper=np.array([3.0, np.inf]),
    )


@pytest.mark.parametrize("solve", [*SOLVERS.values(), lambda form: piqp.solve_form(form, staged=True)])
def test_programs_given_by_arrays(solve) -> None:
    """Known optima (per unit of need, x costs its price and y half of it); honest about what has none."""
    wanted = (
        (FORM, (2.0, 1.0)),
        (buy(), (0.0, 2.0)),
        (buy((1.0, 3.0)), (3.0, 0.5)),
        (buy((1.0, 3.0), 2.0), (2.0, 0.0)),
    )
    for form, x in wanted:
        answer = solve(form)
        assert answer.status == Status.OPTIMAL
        assert answer.x == pytest.approx(x, abs=1e-6)
        assert answer.iterations >= 0
        assert answer.version.split()[0] in SOLVERS
    impossible = solve(dataclasses.replace(FORM, low=np.array([5.0])))
    assert impossible.status in (Status.INFEASIBLE, Status.FAILED)
    assert impossible.message
    assert solve(buy((2.0, -1.0))).status == Status.FAILED  # without end


def rosenbrock() -> pyo.ConcreteModel:
    m = pyo.ConcreteModel()
    m.x = pyo.Var(initialize=-1.2)
    m.y = pyo.Var(initialize=1.0)
    m.cost = pyo.Objective(expr=(1 - m.x) ** 2 + 100 * (m.y - m.x**2) ** 2)
    return m


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_time_limit_stops_one_solve_and_not_the_next(solver: str) -> None:
    """On a dense transport problem that takes every solver more than a moment."""
    size, rng = 60, np.random.default_rng(0)
    supply, demand = (
        sp.kron(*pair) for pair in ((sp.eye(size), np.ones((1, size))), (np.ones((1, size)), sp.eye(size)))
    )
    transport = FreeForm(
        cost=rng.random(size * size),
        equal=sp.csc_matrix((0, size * size)),
        right=np.zeros(0),
        between=sp.csc_matrix(sp.vstack([supply, demand])),
        low=np.repeat([-np.inf, 1.0], size),
        high=np.repeat([1.5, np.inf], size),
        lower=np.zeros(size * size),
        upper=np.full(size * size, np.inf),
    )
    whole = SOLVERS[solver](transport, np.inf)
    assert whole.status == Status.OPTIMAL
    assert SOLVERS[solver](transport, 1e-4).status == Status.TIME_LIMIT
    again = SOLVERS[solver](transport, 60.0)
    assert again.status == Status.OPTIMAL
    assert transport.cost @ again.x == pytest.approx(transport.cost @ whole.x, rel=1e-7)


def test_ipopt_solves_nonlinear_models() -> None:
    model = rosenbrock()
    outcome = CasadiIpopt(model).solve()
    assert outcome.status == Status.OPTIMAL
    assert outcome.iterations > 5
    assert (model.x.value, model.y.value) == pytest.approx((1.0, 1.0))
    model.x.setub(0.5)  # the valley's floor is y = x²
    outcome = CasadiIpopt(model).solve()
    assert outcome.objective == pytest.approx(0.25, abs=1e-6)
