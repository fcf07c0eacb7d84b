"""Claimed, verified, validated: known shares of made-up rows."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from ded_bench.evaluate.ac_summary import validated, with_ac
from ded_bench.run.ac_scoring import AcRow
from ded_bench.run.results import ROWS, Row

FAILED = "scoring failed: no solution"


def row(instance: str, method: str, settings: str = "default", feasible: bool = True) -> Row:
    return Row(
        instance,
        "test",
        "TO",
        method,
        settings,
        "Optimal",
        objective=90.0,
        feasible=feasible,
        fingerprint="now",
    )


def ac(of: Row, objective: float | None, hz: float = 0.0, fingerprint: str = "now") -> AcRow:
    numbers = {} if objective is None else {"freq_violation_hz": hz, "feasible": hz <= 1e-4}
    strict = {} if objective is None else {"feasible_strict": hz <= 1e-6}
    error = FAILED if objective is None else ""
    return AcRow(*of.key, objective=objective, error=error, fingerprint=fingerprint, **numbers, **strict)


@pytest.fixture
def both() -> pd.DataFrame:
    """Three instances, one of which the AC network cannot carry; a row with an old score."""
    ded = [row(name, "ded") for name in "abc"]
    slp = [row(name, "ded-slp", "ac", feasible=False) for name in "abc"]
    old = row("a", "ed")
    scores = [
        *(
            ac(one, objective, hz)
            for one, objective, hz in zip(ded, (101.0, None, None), (2e-3, 0, 0), strict=True)
        ),
        *(ac(one, objective) for one, objective in zip(slp, (100.0, 200.0, None), strict=True)),
        ac(old, 50.0, fingerprint="before"),
    ]
    return with_ac(ROWS.frame([*ded, *slp, old]), scores)


def test_instances_that_the_network_can_carry(both):
    assert set(both["method"]) == {"ded", "ded-slp"}
    assert dict(zip(both["instance"], both["carried"], strict=True)) == {"a": True, "b": True, "c": False}


def test_shares_and_costs(both):
    frame = validated(both).set_index("method")
    ded, slp = frame.loc["ded"], frame.loc["ded-slp"]
    assert ded["instances"] == slp["instances"] == 2
    assert (ded["claimed"], ded["verified"], ded["validated"]) == (1.0, 1.0, 0.0)
    assert (ded["only_verified"], ded["no_solution"]) == (1.0, 0.5)
    assert ded["freq_violation_hz_mean"] == pytest.approx(2e-3)
    assert ded["gap_percent_mean"] == pytest.approx(1.0)
    assert ded["n"] == 1
    assert (slp["verified"], slp["validated"], slp["validated_strict"]) == (0.0, 1.0, 1.0)
    assert slp["gap_percent_mean"] == 0.0


def test_without_a_yardstick_or_rows(both):
    ded = validated(both[both["method"] == "ded"])
    assert ded["n"].tolist() == [0]
    assert math.isnan(ded["gap_percent_mean"][0])
    assert len(validated(both[:0])) == 0
