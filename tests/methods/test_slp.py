"""The loop on one equation, atan(x) = 0, from which Newton's steps run away."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ded_bench.methods.slp import PATIENCE, Attempt, End, Parts, sequence
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

#: Beyond this nothing can be followed.
FAR = 8.0


def follow(at: Array) -> float:
    if abs(at[0]) > FAR:
        raise SimulationError("too far")
    return float(at[0])


def run(start: float, status: Status = Status.OPTIMAL, **limits: int) -> End[float, float]:
    """The linear program gives the place where the tangent is zero."""

    def solve(x: float, _: int) -> Attempt[float]:
        wanted = x - math.atan(x) * (1 + x**2)
        return Attempt(status, np.array([wanted]), wanted, 1, "", "")

    parts = Parts(follow, solve, lambda x, _: abs(math.atan(x)) < 1e-9, **limits)
    return sequence(parts, [np.array([start])], np.inf)


def test_steps_get_there_from_nearby_and_end_where_they_do_not() -> None:
    end = run(0.5)
    assert (end.status, end.message) == (Status.OPTIMAL, "")
    assert end.followed == pytest.approx(0.0, abs=1e-9)
    away = run(3.0, most_programs=2)
    assert (away.status, away.message) == (Status.FAILED, "no convergence in 2 programs")
    assert away.iterations == 2
    stuck = run(3.0, tries=1)  # the first step leads too far to be followed
    assert stuck.status == Status.FAILED
    assert "can be followed: too far" in stuck.message


def test_what_has_no_solution_is_infeasible_after_some_programs() -> None:
    assert run(0.5, Status.INFEASIBLE).iterations == PATIENCE
    assert run(0.5, Status.INFEASIBLE).status == Status.INFEASIBLE
    assert run(0.5, Status.FAILED).status == Status.FAILED


def test_the_first_start_that_can_be_followed_is_taken() -> None:
    parts = Parts(follow, lambda x, _: Attempt(Status.OPTIMAL, None, x, 1, "", ""), stop=None)
    end = sequence(parts, [np.array([2 * FAR]), np.array([0.25])], np.inf)
    assert end.followed == 0.25
    assert (end.status, end.iterations) == (Status.OPTIMAL, 1)
    nowhere = sequence(parts, [np.array([2 * FAR])], np.inf)
    assert (nowhere.status, nowhere.message) == (Status.FAILED, "too far")
    late = sequence(parts, [np.array([0.25])], -np.inf)
    assert (late.status, late.answer) == (Status.TIME_LIMIT, None)
