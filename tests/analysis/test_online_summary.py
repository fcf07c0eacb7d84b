"""Tables of the closed loop from rows with known numbers."""

from __future__ import annotations

import pytest

from ded_bench.analysis.online_summary import online_rows, own_latency, practice_lines, practice_rows
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
    """A method and static dispatch at their own latencies, and what else a folder may hold."""
    rows = [row("a", latency, 101.0 + latency) for latency in (0.0, 1.0, 3.0)]
    rows += [row("a", 0.0, 100.5, forecast="perfect"), row("a", 3.0, 109.0, predicted=False)]
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
    assert one["max_excess_mhz_mean"] == pytest.approx(0.5)
    assert (one["late"], one["failed"], one["infeasible"]) == (2 / 20, 0.0, 8 / 20)
    assert (one["share_outside"], one["slack_travel_pu"]) == (0.25, 2.0)


def test_rows_of_an_older_policy_or_another_plant_are_not_averaged_with_the_newest(tmp_path):
    kept = OnlineResults(tmp_path)
    policy = {"method": "ded-admm", "latency_source": "timing"}
    old = row("a", 0.5, 101.0, policy="ded-admm@old", date="2026-01-01T00:00:00Z", **policy)
    new = {"policy": "ded-admm@new", "date": "2026-01-02T00:00:00Z"} | policy
    kept.table.add([old, row("a", 0.5, 109.0, **new), row("a", 0.5, 150.0, plant="detailed", **new)])
    lines = own_latency(online_rows(kept, "here"))
    assert sorted(lines["increase_percent_mean"]) == pytest.approx([9.0, 50.0])
    titles = dict(zip(lines["increase_percent_mean"].round(), lines["title"], strict=True))
    assert titles == {9.0: "DED-ADMM on lossless", 50.0: "DED-ADMM on detailed"}


def test_lines_tell_from_what_a_plan_started_where_they_differ(tmp_path):
    kept, own = OnlineResults(tmp_path), {"latency_source": "timing"}
    kept.table.add([row("a", 0.5, 101.0, **own), row("a", 0.5, 102.0, warm=False, **own)])
    lines = own_latency(online_rows(kept, "here"))
    assert lines["title"].tolist() == ["DED (SLP) warm", "DED (SLP) cold"]


def test_failures_of_practice_stand_where_nobody_came_to_the_end(tmp_path):
    kept = OnlineResults(tmp_path)
    kept.table.add([row("a", 0.5, None, plans=0, error="loses synchronism")])
    lines = practice_lines(practice_rows(kept, "here"))
    assert lines[["n", "failures"]].to_numpy().tolist() == [[0, 1]]


def test_practice_is_static_dispatch_every_minute_at_once(tmp_path):
    """Whatever else there is of it: late, or asked every second."""
    kept, practice = OnlineResults(tmp_path), {"method": "ed", "settings": "every=60"}
    facts = {"mean_freq_max_hz": 0.1, "agc_travel_pu": 1.0, "cps1": 100.0}
    for latency, period, cost in ((0.0, 60.0, 100.0), (10.0, 60.0, 120.0), (0.0, 1.0, 130.0)):
        kept.table.add([row("a", latency, cost, period_s=period, **practice, **facts)])
    kept.table.add([row("a", 0.5, 101.0, **facts)])
    assert set(practice_rows(kept, "here")["practice_objective"]) == {100.0}


def test_a_sweep_with_a_new_policy_leaves_what_is_announced(tmp_path):
    kept, policy = OnlineResults(tmp_path), {"method": "ded-admm", "latency_source": "timing"}
    old = row("a", 0.5, 101.0, policy="ded-admm@old", date="2026-01-01T00:00:00Z", **policy)
    sweep = {"forecast": "perfect", "policy": "ded-admm@new", "date": "2026-01-02T00:00:00Z"}
    kept.table.add([old, row("a", 0.5, 100.0, **sweep, **policy)])
    assert own_latency(online_rows(kept, "here"))["n"].tolist() == [1]


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
