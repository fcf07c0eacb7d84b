"""Merit order against an LP that is written down and solved independently."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.files.strict import parse_record
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.lossless_case import LosslessCase


def linear_program(p_min, p_max, cost_gen, cost_slack, demand) -> tuple[float, np.ndarray]:
    """min c'P + c_s (u + v), ΣP + u - v = demand, bounds: optimal cost and generator powers."""
    n = len(p_min)
    answer = linprog(
        np.concatenate([cost_gen, [cost_slack, cost_slack]]),
        A_eq=np.concatenate([np.ones(n), [1.0, -1.0]])[None],
        b_eq=[demand],
        bounds=[*zip(p_min, p_max, strict=True), (0, None), (0, None)],
        method="highs",
    )
    assert answer.success
    return answer.fun, answer.x[:n]


def cost_of(p_gen, cost_gen, cost_slack, demand) -> float:
    """The static objective of generator powers, the slack bus taking the rest."""
    return float(p_gen @ cost_gen + cost_slack * abs(demand - p_gen.sum()))


@pytest.fixture(scope="module", params=range(1, 6))
def star(request, threebus) -> Case:
    """A made-up case with one to five generators around a load; some may consume (p_min < 0)."""
    rng = np.random.default_rng([11, request.param])
    data = json.loads(threebus.model_dump_json(by_alias=True))
    names = [f"g{i}" for i in range(request.param)]
    low = rng.uniform(-0.3, 0.6, len(names))
    high = low + rng.uniform(0.1, 1.0, len(names))
    data["buses"] = [bus for bus in data["buses"] if bus["kind"] != "generator"]
    data["buses"] += [{"id": name, "kind": "generator", "v": 1.0} for name in names]
    data["lines"] = [{"from": bus, "to": "town", "r": 0.0, "x": 0.1} for bus in ("s", *names)]
    data["machines"] = {
        name: {"m": 1.0, "d": 1.0, "p_nominal": a, "p_min": a, "p_max": b}
        for name, a, b in zip(names, low.tolist(), high.tolist(), strict=True)
    }
    return parse_record(LosslessCase, json.dumps(data), "star")


def test_merit_order_is_optimal_on_random_cases(star):
    """100 draws each: demand below, inside and above what the generators can do."""
    rng = np.random.default_rng(len(star.generators))
    for _ in range(100):
        cost_gen, cost_slack = rng.random(len(star.generators)), rng.random()
        demand = rng.uniform(star.p_min.sum() - 0.5, star.p_max.sum() + 0.5)
        p_gen = merit_order(star, cost_gen, cost_slack, np.array([-demand]))
        best, p_lp = linear_program(star.p_min, star.p_max, cost_gen, cost_slack, demand)
        assert cost_of(p_gen, cost_gen, cost_slack, demand) == pytest.approx(best, abs=1e-9)
        np.testing.assert_allclose(p_gen, p_lp, rtol=0, atol=1e-9)  # unique: costs differ almost surely


def test_merit_order_on_ties_and_zero_costs(ninebus):
    """Where the optimum is not unique, it is still an optimum within the bounds."""
    for cost_gen in ([0.0, 0.0], [0.3, 0.3], [0.3, 0.0], [1.0, 0.3]):
        for cost_slack in (0.0, 0.3):
            for demand in (0.2, 1.24, 2.0, 3.72, 5.0):
                p_gen = merit_order(ninebus, np.array(cost_gen), cost_slack, np.array([-demand, 0.0, 0.0]))
                best, _ = linear_program(ninebus.p_min, ninebus.p_max, cost_gen, cost_slack, demand)
                assert cost_of(p_gen, np.array(cost_gen), cost_slack, demand) == pytest.approx(best, abs=1e-9)
                assert (p_gen >= ninebus.p_min - 1e-12).all()
                assert (p_gen <= ninebus.p_max + 1e-12).all()


def test_merit_order_of_one_generator_in_closed_form(threebus):
    """Cheaper than the slack: the demand, clipped to its bounds. Dearer: its lower bound."""
    p_load = -np.array([[0.2], [0.3], [0.55], [0.9], [1.2]])
    cheap = merit_order(threebus, np.array([0.1]), 0.2, p_load)
    np.testing.assert_allclose(cheap[:, 0], [0.3, 0.3, 0.55, 0.9, 0.9], rtol=0, atol=1e-15)
    dear = merit_order(threebus, np.array([0.2]), 0.1, p_load)
    np.testing.assert_array_equal(dear[:, 0], 0.3)
