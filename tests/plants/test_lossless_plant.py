"""Trajectories along which plans are linearised: near the scorer's, by a method of order 4."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.surrogates.planned_trajectory import METHOD, simulate_plan
from ded_bench.methods import ed
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import sample_instance
from ded_bench.plants.simulate import SimulationError, simulate


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus", "140bus"])
def test_it_is_the_scorers_within_a_microhertz(name: str) -> None:
    """Under the static dispatch of every second, which shakes frequencies more than any plan does."""
    case = Case.load(name)
    instance = sample_instance(case, 77, 0).model_copy(update={"horizon_s": 20.0})
    schedule = ed.dispatch(case, instance, 1.0)
    plan, truth = simulate_plan(case, instance, schedule), simulate(case, instance, schedule)
    np.testing.assert_allclose(plan.omega, truth.omega, atol=2 * np.pi * 1e-6)
    np.testing.assert_allclose(plan.p_slack, truth.p_slack, atol=5e-6)
    np.testing.assert_array_equal(plan.p_gen, truth.p_gen)


def test_the_method_has_order_four() -> None:
    """The conditions of order, by sums over rooted trees (Hairer, Norsett and Wanner, table II.2.2)."""
    a, b, c = METHOD
    np.testing.assert_allclose(a.sum(axis=1), c)
    trees = [np.ones(4), c, c**2, a @ c, c**3, c * (a @ c), a @ c**2, a @ a @ c]
    np.testing.assert_allclose(
        [b @ tree for tree in trees], [1, 1 / 2, 1 / 3, 1 / 6, 1 / 4, 1 / 8, 1 / 12, 1 / 24]
    )


def test_what_cannot_be_followed_is_said(case: Case) -> None:
    """Loads that ramp beyond what the network can deliver."""
    instance = sample_instance(case, 77, 0)
    change = {"start": 0.0, "duration": 50.0, "rate": -20.0}
    load = {bus: ramp.model_copy(update=change) for bus, ramp in instance.load.items()}
    heavy = instance.model_copy(update={"load": load})
    with pytest.raises(SimulationError, match="cannot follow"):
        simulate_plan(case, heavy, ed.dispatch(case, instance, 1.0))
