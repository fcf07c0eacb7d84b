"""What several tests of methods share."""

from __future__ import annotations

from typing import Any

import pytest

from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import linear_model


@pytest.fixture(scope="module")
def koopman(case: Case) -> Koopman:
    """The linearisation, starting from exact equilibria."""
    return linear_model(case)


@pytest.fixture
def instance(island: Case, quiet_instance: Any) -> Instance:
    """Loads that ramp one after another, and machines of different costs."""
    load = {
        bus: {"initial": value, "start": 0.5 + i, "duration": 3.0, "rate": 0.01 * value * (-1) ** i}
        for i, (bus, value) in enumerate(zip(island.loads, island.load_nominal.tolist(), strict=True))
    }
    cost = {name: 0.2 + 0.1 * i for i, name in enumerate(island.generators)}
    return quiet_instance(island, horizon_s=8.0, load=load, cost=cost)
