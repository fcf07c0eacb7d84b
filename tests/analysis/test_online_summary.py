"""Tables of the closed loop from rows with known numbers."""

from __future__ import annotations

import dataclasses

import pytest

from ded_bench.analysis.online_summary import crossed, online_rows, own_latency, sweeps
from ded_bench.results.online_results import OnlineResults, OnlineRow


def row(scenario: str, latency_s: float, objective: float | None, **changes) -> OnlineRow:
    """A row of a swept method; hindsight costs 100."""
    done = objective is not None
    facts = {
        "increase_percent": objective - 100.0 if done else None,
        "max_excess_hz": 1e-3 * latency_s if done else None,
        "mean_excess_hz": 0.0 if done else None,
        "share_outside": 0.25 if done else None,
        "slack_travel_pu": 2.0 if done else None,
        "plans": 10,
        "latency_source": "given",
        "case": "here",
    }
    key = {"regime": "TO", "method": "ded-slp", "settings": "default", "period_s": 1.0}
    what = {"forecast": "announced", "predicted": True, "warm": True}
    return OnlineRow(
        **key
        | what
        | facts
        | {"scenario": scenario, "latency_s": latency_s, "objective": objective}
        | changes
    )


@pytest.fixture
def results(tmp_path) -> OnlineResults:
    """Two scenarios at three latencies, a third at two of them, and what else a folder may hold."""
    rows = [row(s, latency, 101.0 + latency + i) for i, s in enumerate("ab") for latency in (0.0, 1.0, 3.0)]
    rows += [row("c", latency, 150.0) for latency in (0.0, 1.0)]
    rows += [row(s, 0.0, 100.5, forecast="perfect") for s in "abc"]
    rows += [row(s, 3.0, 109.0, predicted=False) for s in "ab"]
    rows += [row("a", 3.0, 130.0, predicted=False, forecast="perfect"), row("a", 1.0, 120.0, warm=False)]
    rows += [row(s, 0.5, 102.0, latency_source="timing", late=1, infeasible=4) for s in "ab"]
    rows += [row("c", 0.5, None, latency_source="timing", plans=0, failed=0, error="loses synchronism")]
    rows += [row("a", 0.5, 103.0, method="ed", latency_source="timing", case="elsewhere")]
    static = {"method": "ed", "settings": "every=1", "latency_source": "timing"}
    rows += [row(s, 0.002, 102.0 + i, **static) for i, s in enumerate("ab")]
    kept = OnlineResults(tmp_path)
    kept.table.add(rows)
    return kept


def test_methods_at_their_own_latency(results):
    """Rows of this case alone; failures count, but not in means; plans are counted over all."""
    one, static = own_latency(online_rows(results, "here")).to_dict("records")
    assert one["over_static_percent_mean"] == pytest.approx(50 * (102.0 / 103.0 - 1))
    assert one["static_excess_mhz_mean"] == static["max_excess_mhz_mean"] == pytest.approx(0.002)
    assert static["over_static_percent_mean"] == 0.0
    assert (one["method"], one["latency_s"], one["n"], one["failures"]) == ("ded-slp", 0.5, 2, 1)
    assert one["increase_percent_mean"] == pytest.approx(2.0)
    assert one["over_known_percent_mean"] == pytest.approx(100 * (102.0 / 100.5 - 1))
    assert one["max_excess_mhz_mean"] == pytest.approx(0.5)
    assert (one["late"], one["failed"], one["infeasible"]) == (2 / 20, 0.0, 8 / 20)
    assert (one["share_outside"], one["slack_travel_pu"]) == (0.25, 2.0)


def test_own_latencies_that_hardly_differ_share_a_line(tmp_path):
    """As after `bench` was run anew; half as long a latency is another line."""
    kept = OnlineResults(tmp_path)
    kept.table.add(
        [
            row(s, t, 102.0, latency_source="timing")
            for s, t in zip("abcd", (0.2, 0.2, 0.2001, 0.1), strict=True)
        ]
    )
    lines = own_latency(online_rows(kept, "here"))
    assert lines[["latency_s", "n"]].to_numpy().tolist() == [[0.2, 3], [0.1, 1]]


def test_sweeps_are_about_the_same_scenarios(results):
    """Cold starts and other present states do not count, nor what few scenarios were operated under."""
    lines = sweeps(online_rows(results, "here"))
    assert set(lines["n"]) == {2}
    found = lines.set_index(["kind", "latency_s"])["increase_percent_mean"].to_dict()
    assert found == pytest.approx(
        {
            ("announced", 0.0): 1.5,
            ("announced", 0.5): 2.0,
            ("announced", 1.0): 2.5,
            ("announced", 3.0): 4.5,
            ("perfect", 0.0): 0.5,
            ("present", 3.0): 9.0,
        }
    )
    wide = crossed(lines)
    assert wide["latency_s"].tolist() == [0.0, 0.5, 1.0, 3.0]
    assert wide["increase_percent_mean_announced"].tolist() == pytest.approx([1.5, 2.0, 2.5, 4.5])
    assert wide["increase_percent_mean_present"].isna().tolist() == [True, True, True, False]
    assert wide["max_excess_mhz_mean_announced"].tolist() == pytest.approx([0.0, 0.5, 1.0, 3.0])


def test_a_sweep_has_one_period(tmp_path):
    """Ten plans a second at one latency are no part of a sweep of one plan a second."""
    results = OnlineResults(tmp_path)
    once = [row("a", latency, 102.0) for latency in (0.0, 0.5, 1.0, 3.0)]
    results.table.add([*once, dataclasses.replace(row("a", 0.5, 150.0), period_s=0.1)])
    lines = sweeps(online_rows(results, "here"))
    assert lines["latency_s"].tolist() == [0.0, 0.5, 1.0, 3.0]
    assert lines["increase_percent_mean"].nunique() == 1
