"""Traditional dispatch: closed forms on the three-bus case, limits kept, finer intervals track better."""

from __future__ import annotations

import numpy as np

from ded_bench.methods.ed import dispatch
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order

RAMP = 0.05  # pu/s, both cases


def test_constant_loads_are_met_at_the_ramp_limit_and_then_held(threebus: Case, quiet_instance) -> None:
    """The plant is cheaper than the slack: from 0.6 pu it takes 4 s to its limit of 0.8 pu."""
    load = {"town": {"initial": -0.8, "start": 0.0, "duration": 0.0, "rate": 0.0}}
    instance = quiet_instance(threebus, cost={"s": 0.9, "plant": 0.2}, load=load)
    wanted = np.minimum(0.6 + RAMP * instance.grid, 0.8)
    for interval in (60.0, 10.0, 1.0):
        np.testing.assert_allclose(dispatch(threebus, instance, interval).p[:, 0], wanted, atol=1e-14)
    dear = quiet_instance(threebus, cost={"s": 0.2, "plant": 0.9}, load=load)
    down = np.maximum(0.6 - RAMP * dear.grid, threebus.p_min[0])
    np.testing.assert_allclose(dispatch(threebus, dear, 60.0).p[:, 0], down, atol=1e-14)


def test_an_interval_gets_the_dispatch_of_its_mean_load(threebus: Case, quiet_instance) -> None:
    """Load -0.6 - 0.02 t: the mean of second j is 0.61 + 0.02 j, reached in 0.4 s and held."""
    load = {"town": {"initial": -0.6, "start": 0.0, "duration": 6.0, "rate": -0.02}}
    instance = quiet_instance(threebus, cost={"s": 0.9, "plant": 0.2}, load=load)
    every_second = dispatch(threebus, instance, 1.0)
    np.testing.assert_allclose(every_second.p[100::100, 0], 0.61 + 0.02 * np.arange(6), atol=1e-12)
    np.testing.assert_allclose(every_second.p[120, 0], 0.62, atol=1e-12)  # half of the way from 0.61 to 0.63
    once = dispatch(threebus, instance, 60.0)
    np.testing.assert_allclose(once.p[-1, 0], 0.66, atol=1e-12)
    at_once = dispatch(threebus, instance, 1e-9)  # never finer than the grid
    np.testing.assert_allclose(at_once.p[1:, 0], 0.6 + 0.02 * (instance.grid[1:] - 0.005), atol=1e-12)


def test_a_last_short_interval_is_dispatched_too(threebus: Case, quiet_instance) -> None:
    load = {"town": {"initial": -0.6, "start": 4.0, "duration": 2.0, "rate": -0.02}}
    instance = quiet_instance(threebus, cost={"s": 0.9, "plant": 0.2}, load=load)
    power = dispatch(threebus, instance, 4.0).p[:, 0]
    np.testing.assert_allclose(power[:401], 0.6, atol=1e-12)
    np.testing.assert_allclose(power[-1], 0.62, atol=1e-12)


def test_slow_loads_are_followed_to_the_static_optimum(ninebus: Case, quiet_instance) -> None:
    """Finer intervals come nearer to the dispatch of the load of the moment, in first order."""
    load = {
        bus: {"initial": nominal, "start": 5.0, "duration": 50.0, "rate": -0.002}
        for bus, nominal in zip(ninebus.loads, ninebus.load_nominal.tolist(), strict=True)
    }
    power = {"2": 1.63, "3": 1.275}
    cost = {"s": 0.9, "2": 0.3, "3": 0.1}
    initial = {"power": power, "omega": {"2": 0.0, "3": 0.0}}
    instance = quiet_instance(ninebus, cost=cost, load=load, initial=initial)
    wanted = merit_order(
        ninebus, instance.cost_gen(ninebus), instance.cost_slack(ninebus), instance.p_load(ninebus)
    )
    late = instance.grid > 20.0  # by then P_0's mismatch is gone
    errors = [
        np.abs(dispatch(ninebus, instance, interval).p - wanted)[late].max() for interval in (8.0, 4.0, 2.0)
    ]
    assert errors[-1] < 0.02
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.05)
