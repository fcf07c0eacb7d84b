"""Programs of sines: power over one line, where the optimum is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp

from ded_bench.solvers.sine_program import SineNumbers, SineProgram
from ded_bench.solvers.status import Status

COUPLING = 5.0


@pytest.fixture
def line() -> SineProgram:
    """Row 0: power over a line, COUPLING sin(δ) - p = 0; row 1: w p, with a weight w that instances give."""
    return SineProgram(sp.csc_matrix([[COUPLING], [0.0]]), sp.csc_matrix([[1.0, 0.0]]))


def numbers(weight: float = 1.0, least: float = -np.inf, cost: float = -1.0) -> SineNumbers:
    """Columns δ in [0, π], p: minimise cost p + 7 with weight p >= least."""
    return SineNumbers(
        a=sp.csc_matrix(([-1.0, weight], ([0, 1], [1, 1])), shape=(2, 2)),
        row_lower=np.array([0.0, least]),
        row_upper=np.array([0.0, np.inf]),
        lower=np.array([0.0, -np.inf]),
        upper=np.array([np.pi, np.inf]),
        cost=np.array([0.0, cost]),
        constant=7.0,
        start=np.array([0.3, 1.0]),
    )


def test_most_power_flows_at_a_right_angle(line: SineProgram) -> None:
    """Then, by other numbers, the least that a row allows; from the same start."""
    outcome, x = line.solve(numbers())
    assert outcome.status == Status.OPTIMAL
    assert x == pytest.approx([np.pi / 2, COUPLING], abs=1e-4)
    assert outcome.objective == pytest.approx(7.0 - COUPLING, abs=1e-6)
    outcome, x = line.solve(numbers(weight=2.0, least=COUPLING, cost=3.0))
    assert x == pytest.approx([np.pi / 6, COUPLING / 2], abs=1e-6)
    assert outcome.objective == pytest.approx(7.0 + 1.5 * COUPLING, abs=1e-6)
    assert outcome.iterations > 0
    assert outcome.version.startswith("ipopt")


def test_more_than_the_line_carries_is_infeasible(line: SineProgram) -> None:
    outcome, x = line.solve(numbers(least=1.1 * COUPLING))
    assert outcome.status == Status.INFEASIBLE
    assert x is None
    assert outcome.objective is None
    assert outcome.message


def test_a_time_limit_stops_one_solve_and_not_the_next(line: SineProgram) -> None:
    assert line.solve(numbers(), 1e-9)[0].status == Status.TIME_LIMIT
    assert line.solve(numbers(), 60.0)[0].status == Status.OPTIMAL


def test_what_ipopt_cannot_read_fails_with_its_reason(line: SineProgram) -> None:
    outcome, x = line.solve(dataclasses.replace(numbers(), lower=np.array([4.0, 0.0])))
    assert outcome.status == Status.FAILED
    assert x is None
    assert outcome.message
