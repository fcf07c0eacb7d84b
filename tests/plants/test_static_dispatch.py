"""Static dispatch of islands: optimal against a nonlinear program, balanced, within ramps and limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instances


@pytest.fixture(scope="module")
def island() -> Case:
    return Case.load("two-area-agc")


@pytest.fixture(scope="module")
def drawn(island: Case) -> list[Instance]:
    """Instances whose powers at t = 0 are balanced."""
    return [plant_of(island).balanced(i) for i in sample_instances(island, 3, 4)]


def test_the_cheapest_powers_are_those_of_a_nonlinear_program(island: Case, drawn: list[Instance]) -> None:
    """SciPy's SLSQP on the power flow's balance, losses and transfer included: cost to 1e-6 relative."""
    dispatcher = plant_of(island).dispatcher
    for instance in drawn:
        cost, load = instance.cost_gen(island), instance.p_load(island, np.zeros(1))[0]
        start = dispatcher.weigh(instance.p_initial(island), load)
        found = dispatcher.cheapest(cost, load, start)

        def short(power: Array, load: Array = load) -> float:
            return dispatcher.weigh(power, load).short

        def room(power: Array, load: Array = load) -> Array:
            return -island.transfer_excess(power, load)

        best = minimize(
            lambda power, cost=cost: cost @ power,
            start.power,
            bounds=list(zip(island.p_min, island.p_max, strict=True)),
            constraints=[{"type": "eq", "fun": short}, {"type": "ineq", "fun": room}],
            method="SLSQP",
            options={"ftol": 1e-12},
        )
        assert best.success
        assert abs(found.short) < 1e-9
        assert room(found.power).min() > -1e-9
        assert cost @ found.power == pytest.approx(best.fun, rel=1e-6)


def test_a_course_balances_within_ramps_and_limits(island: Case, drawn: list[Instance]) -> None:
    """It starts at P₀; each of its powers balances loads and losses on the AC power flow to 1e-6 pu."""
    plant, times = plant_of(island), np.arange(0.0, 60.5, 2.0)
    for instance in drawn:
        powers = plant.static_dispatch(instance, times)
        np.testing.assert_allclose(powers[0], instance.p_initial(island), rtol=0, atol=1e-15)
        assert (np.abs(np.diff(powers, axis=0)) <= 2.0 * island.ramp + 1e-12).all()
        assert ((island.p_min <= powers) & (powers <= island.p_max)).all()
        loads = instance.p_load(island, times)
        short = [plant.dispatcher.weigh(p, load).short for p, load in zip(powers, loads, strict=True)]
        assert np.abs(short).max() < 1e-6


@pytest.mark.parametrize("beyond", ["limit", "transfer"])
def test_what_begins_beyond_a_limit_comes_back_within_ramps(
    island: Case, drawn: list[Instance], beyond: str
) -> None:
    """A machine above its largest power, or a group above its transfer: balanced, second after second."""
    (group,), instance, times = island.transfer_rows[0] > 0, drawn[0], np.arange(0.0, 5.0)
    start, loads = instance.p_initial(island), instance.p_load(island, times)
    moved = np.where(group, 1.0, -1.0) * (1.0 - island.transfer_excess(start, loads[0]).max()) / group.sum()
    if beyond == "limit":
        above = island.p_max[0] + 0.3 - start[0]
        moved = np.array([above, 0.0, *np.full(len(start) - 2, -above / (len(start) - 2))])
    power = dict(zip(island.generators, (start + moved).tolist(), strict=True))
    instance = instance.model_copy(update={"initial": instance.initial.model_copy(update={"power": power})})
    dispatcher = plant_of(island).dispatcher
    powers = dispatcher.course(instance, times)
    assert (np.abs(np.diff(powers, axis=0)) <= island.ramp + 1e-9).all()
    excess = [(p - island.p_max).max() for p in powers]
    if beyond == "transfer":
        excess = [island.transfer_excess(p, load).max() for p, load in zip(powers, loads, strict=True)]
    assert excess[0] == pytest.approx(0.3 if beyond == "limit" else 1.0)
    assert excess == sorted(excess, reverse=True)
    assert excess[-1] < excess[0] - 0.1
    assert abs(dispatcher.weigh(powers[-1], loads[-1]).short) < 1e-6


def test_slow_loads_make_balanced_powers_a_share_of_what_each_can_move(
    island: Case, drawn: list[Instance]
) -> None:
    """Without a transfer at its limit all machines move by the same part of their room, in one direction."""
    load = island.load_nominal
    found = plant_of(island).dispatcher.balanced(island.p_nominal - 0.1, load)
    part = (found.power - island.p_nominal + 0.1) / (island.p_max - island.p_nominal + 0.1)
    np.testing.assert_allclose(part, part[0], rtol=1e-6)
    assert part[0] > 0.0
