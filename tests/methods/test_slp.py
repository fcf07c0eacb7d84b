"""The loop and its step rules on one equation, atan(x) = 0, from which Newton's steps run away."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ded_bench.methods.slp import PATIENCE, End, Parts, sequence
from ded_bench.methods.step_rules import FullSteps, TrustRegion
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

#: Beyond this nothing can be followed.
FAR = 8.0


@dataclass(frozen=True)
class Place:
    at: Array
    cost: float = 1.0

    @property
    def over(self) -> float:
        return abs(math.atan(self.at[0]))


def follow(at: Array) -> Place:
    if abs(at[0]) > FAR:
        raise SimulationError("too far")
    return Place(at)


def solve(rule: Any, place: Place, status: Status = Status.OPTIMAL) -> SimpleNamespace:
    """The linear program: where the tangent is zero, or as near as the radius lets."""
    (x,) = place.at
    step = np.clip(-math.atan(x) * (1 + x**2), -rule.radius, rule.radius)
    omega = np.array([math.atan(x) + step / (1 + x**2)])
    prediction = SimpleNamespace(objective=1.0, omega=omega)
    said = {"iterations": 1, "version": "", "message": "", "status": status}
    return SimpleNamespace(wanted=np.array([x + step]), prediction=prediction, **said)


def run(rule: Any, start: float, status: Status = Status.OPTIMAL) -> End[Any, Any]:
    parts = Parts(follow, lambda at, _: solve(rule, at, status), rule, lambda at, _: at.over < 1e-9)
    return sequence(parts, [np.array([start])], np.inf)


def region() -> TrustRegion:
    return TrustRegion(1.0, lambda omega: float(np.abs(omega).max()))


@pytest.mark.parametrize("start", [-7.0, -2.0, 0.5, 3.0])
def test_a_trust_region_gets_there(start: float) -> None:
    end = run(region(), start)
    assert (end.status, end.message) == (Status.OPTIMAL, "")
    assert end.followed.at[0] == pytest.approx(0.0, abs=1e-9)


def test_full_steps_do_from_nearby_and_end_where_they_do_not() -> None:
    assert run(FullSteps(), 0.5).status == Status.OPTIMAL
    away = run(FullSteps(most_programs=2), 3.0)
    assert (away.status, away.message) == (Status.FAILED, "no convergence in 2 programs")
    assert away.iterations == 2
    stuck = run(FullSteps(tries=1), 3.0)  # the first step leads too far to be followed
    assert stuck.status == Status.FAILED
    assert "can be followed: too far" in stuck.message


def test_what_has_no_solution_is_infeasible_after_some_programs() -> None:
    assert run(FullSteps(), 0.5, Status.INFEASIBLE).iterations == PATIENCE
    assert run(FullSteps(), 0.5, Status.INFEASIBLE).status == Status.INFEASIBLE
    assert run(FullSteps(), 0.5, Status.FAILED).status == Status.FAILED


def test_the_first_start_that_can_be_followed_is_taken() -> None:
    rule = FullSteps()
    parts = Parts(follow, lambda at, _: solve(rule, at), rule, stop=None)
    end = sequence(parts, [np.array([2 * FAR]), np.array([0.25])], np.inf)
    assert end.followed.at[0] == 0.25
    assert (end.status, end.iterations) == (Status.OPTIMAL, 1)
    nowhere = sequence(parts, [np.array([2 * FAR])], np.inf)
    assert (nowhere.status, nowhere.message) == (Status.FAILED, "too far")
    late = sequence(parts, [np.array([0.25])], -np.inf)
    assert (late.status, late.answer) == (Status.TIME_LIMIT, None)
