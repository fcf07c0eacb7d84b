"""Load ramps and the time grid of an instance."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.problem.instance import LoadRamp
from ded_bench.problem.sampling import sample_instance


@pytest.mark.parametrize("rate", [-0.03, 0.0, 0.02])
@pytest.mark.parametrize("duration", [0.0, 2.5, 20.0])
def test_load_ramp_follows_the_papers_three_branches(rate, duration):
    """Before, during and after the ramp; 20 s from t = 3 s ends beyond a horizon of 10 s."""
    ramp = LoadRamp(initial=-0.9, start=3.0, duration=duration, rate=rate)
    t = np.linspace(0.0, 10.0, 1001)
    branches = np.where(
        t <= 3.0, -0.9, np.where(t <= 3.0 + duration, -0.9 + rate * (t - 3.0), -0.9 + rate * duration)
    )
    np.testing.assert_allclose(ramp.at(t), branches, rtol=0, atol=1e-15)


def test_a_ramp_may_start_or_end_beyond_the_horizon():
    """It is cut off, not squeezed: at the horizon only the part before it has happened."""
    t = np.array([0.0, 59.0, 60.0])
    late = LoadRamp(initial=-1.0, start=59.5, duration=20.0, rate=-0.04)
    np.testing.assert_allclose(late.at(t), [-1.0, -1.0, -1.02], rtol=1e-15)
    never = LoadRamp(initial=-1.0, start=60.0, duration=5.0, rate=-0.04)
    np.testing.assert_array_equal(never.at(t), -1.0)


def test_loads_come_in_the_order_of_the_case(case):
    """Column j of p_load is the j-th load bus, whatever the order in the file."""
    instance = sample_instance(case, 3, 4)
    p_load = instance.p_load(case)
    assert p_load.shape == (instance.steps + 1, len(case.loads))
    for column, bus in zip(p_load.T, case.loads, strict=True):
        ramp = instance.load[bus]
        by_hand = [
            ramp.initial + ramp.rate * min(max(t - ramp.start, 0.0), ramp.duration) for t in instance.grid
        ]
        np.testing.assert_allclose(column, by_hand, rtol=0, atol=1e-15)


def test_the_grid_has_one_point_more_than_steps(case, quiet_instance):
    """t_k = k dt from 0 to the horizon; a step that is no binary fraction still divides it."""
    instance = quiet_instance(case)
    assert len(instance.grid) == instance.steps + 1 == round(case.sampling.horizon_s / 0.01) + 1
    np.testing.assert_array_equal(instance.grid, [k * 0.01 for k in range(instance.steps + 1)])
    assert instance.grid[-1] == pytest.approx(case.sampling.horizon_s, abs=1e-12)
    assert quiet_instance(case, horizon_s=0.3, dt_s=0.1).steps == 3
    assert quiet_instance(case, horizon_s=7, dt_s=7).steps == 1


def test_vectors_follow_the_order_of_the_case(ninebus, quiet_instance):
    """Dictionaries in a file may be in any order."""
    instance = quiet_instance(
        ninebus,
        cost={"3": 0.3, "s": 0.1, "2": 0.2},
        initial={"power": {"3": 0.9, "2": 1.2}, "omega": {"3": -0.003, "2": 0.002}},
    )
    np.testing.assert_array_equal(instance.cost_gen(ninebus), [0.2, 0.3])
    assert instance.cost_slack(ninebus) == 0.1
    np.testing.assert_array_equal(instance.p_initial(ninebus), [1.2, 0.9])
    np.testing.assert_array_equal(instance.omega_initial(ninebus), [0.002, -0.003])
