"""Gaps and rates, on small tables with answers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from ded_bench.analysis.summary import (
    GROUP,
    findings,
    gaps,
    judged_elsewhere,
    largest_violation,
    named,
    outcome,
    summary,
)
from ded_bench.results.rows import ROWS, Row

DED = ("ded", "default")
BROKEN = {"freq_violation_hz": 0.003, "feasible": False}
NO_TIMES = pd.DataFrame([], columns=[*GROUP, "time_s", "failures"])


def row(instance: str, method: str, objective: float | None = None, **fields: object) -> Row:
    """A scored, feasible row unless the fields say otherwise; no objective: a failure."""
    scored = objective is not None
    facts: dict[str, object] = {
        "split": "test",
        "regime": "TO",
        "settings": "default",
        "status": "Optimal" if scored else "Failed",
        "solve_s": 1.0,
        "objective": objective,
        "freq_violation_hz": 0.0 if scored else None,
        "ramp_violation": 0.0 if scored else None,
        "bound_violation": 0.0 if scored else None,
        "initial_violation": 0.0 if scored else None,
        "feasible": True if scored else None,
        "feasible_strict": True if scored else None,
    }
    return Row(instance=instance, method=method, **(facts | fields))  # type: ignore[arg-type]


def frame_of(*rows: Row) -> pd.DataFrame:
    """A results frame, as a report reads it."""
    return named(ROWS.frame(rows))


def with_gaps(frame: pd.DataFrame, reference: tuple[str, str] = DED) -> pd.DataFrame:
    """Rows with their gaps to a method's rows in the same table."""
    own = frame[(frame["method"] == reference[0]) & (frame["settings"] == reference[1])]
    return gaps(frame, own.set_index(["instance", "regime"])["objective"])


@pytest.fixture
def table() -> pd.DataFrame:
    """Four instances; ded-ko has gaps 1, -1 and 4 %, one failure, and one row without DED."""
    return frame_of(
        row("a", "ded", 100.0),
        row("b", "ded", 200.0),
        row("c", "ded", 1000.0),
        row("d", "ded"),
        row("e", "ded", 50.0),
        row("a", "ded-ko", 101.0, freq_violation_hz=2e-4, feasible=False, feasible_strict=False),
        row("b", "ded-ko", 198.0, freq_violation_hz=1e-5, feasible_strict=False),
        row("c", "ded-ko", 1040.0),
        row("d", "ded-ko", 10.0),
        row("e", "ded-ko", status="TimeLimit"),
    )


def test_gaps_are_signed_percent_of_ded(table: pd.DataFrame) -> None:
    ours = with_gaps(table).set_index(["method", "instance"])["gap_percent"]
    assert ours["ded-ko"][["a", "b", "c"]].to_list() == pytest.approx([1.0, -1.0, 4.0])
    assert math.isnan(ours["ded-ko", "d"])  # DED has no score there
    assert math.isnan(ours["ded-ko", "e"])  # ded-ko has none
    assert (ours["ded"].dropna() == 0).all()


def test_summary_counts_and_spreads(table: pd.DataFrame) -> None:
    ko = summary(with_gaps(table)).set_index("method").loc["ded-ko"]
    assert (ko["rows"], ko["n"], ko["failures"], ko["unpaired"]) == (5, 3, 1, 1)
    assert ko["gap_percent_mean"] == pytest.approx(4 / 3)
    assert ko["gap_percent_median"] == pytest.approx(1.0)
    assert ko["gap_percent_max"] == pytest.approx(4.0)
    assert ko["gap_percent_p95"] == pytest.approx(np.quantile([1, -1, 4], 0.95))
    assert ko["freq_violation_hz_mean"] == pytest.approx((2e-4 + 1e-5) / 4)
    assert ko["freq_violation_hz_max"] == pytest.approx(2e-4)
    assert ko["cost_ratio"] == pytest.approx((101 + 198 + 1040) / (100 + 200 + 1000))


def test_claims_and_verdicts_are_separate_rates(table: pd.DataFrame) -> None:
    ko = summary(with_gaps(table)).set_index("method").loc["ded-ko"]
    assert ko["success_rate"] == pytest.approx(4 / 5)
    assert ko["correct_rate"] == pytest.approx(3 / 5)
    assert ko["strict_rate"] == pytest.approx(2 / 5)


def test_the_largest_violation_names_its_limit() -> None:
    """In units of its tolerance, which is stricter on an island."""
    far = {"freq_violation_hz": 5e-5, "ramp_violation": 3e-6, "bound_violation": 1e-7}
    assert largest_violation(frame_of(row("a", "ded", 1.0, **far))) == "3e-06 pu (ramp)"
    assert (
        largest_violation(frame_of(row("a", "ded", 1.0, **far, excess_mean_hz=0.0))) == "5e-05 Hz (frequency)"
    )
    assert largest_violation(frame_of(row("a", "ded", 1.0, freq_violation_hz=5e-5))) == "none"
    assert largest_violation(frame_of(row("a", "ded"))) == "–"


def test_tradeoff_prefers_times_taken_alone(table: pd.DataFrame) -> None:
    points = outcome(
        with_gaps(table), pd.DataFrame([["TO", "ded-ko", "default", "", 0.25, 0]], columns=NO_TIMES.columns)
    ).set_index("method")
    assert points.loc["ded-ko", ["rows", "solved", "feasible"]].to_list() == [5, 4, 3]
    assert points.loc["ded-ko", "seconds"] == 0.25
    assert points.loc["ded-ko", "alone"]
    assert points.loc["ded", "seconds"] == 1.0
    assert not points.loc["ded", "alone"]


def test_findings_name_the_limit_that_is_broken() -> None:
    """Own methods and those that failed, too; what was run on fewer instances is not the fastest."""
    mine = row("a", "mine", 101.0, ramp_violation=0.02, feasible=False, solve_s=None)
    full = [row(name, "ded", 100.0, build_s=0.5, solve_s=1.5) for name in "ab"]
    few, broken = row("a", "ded-slp", 100.0, solve_s=0.1), row("a", "ed", 1.0, **BROKEN)
    frame = with_gaps(frame_of(*full, few, mine, broken, row("b", "ed")))
    said = list(findings(outcome(frame), "DED"))
    assert said == [
        "**TO:** 1 of 4 methods and settings keep every limit on every instance; the fastest of these is "
        "DED (+0 % over DED, 2 s).",
        "**mine TO:** mine (+1 % over DED, not timed); it keeps every limit on 0 of 1 instances; "
        "largest violation: 0.02 pu (ramp).",
        "**ED TO** failed on 1 of 2 instances.",
        "Limits are broken, on some instance, by up to: ED TO by 0.003 Hz (frequency).",
    ]


def test_other_judges_count_what_they_could_judge() -> None:
    """Three schedules kept, of which full models carry two; what nobody was given counts nowhere."""
    rows = [row(name, "ded", 1.0) for name in "abcd"]
    frame = with_gaps(frame_of(*rows)).assign(key=[r.key for r in rows])
    said = {"validated": dict(zip((r.key for r in rows), (True, False, None), strict=False)), "confirmed": {}}
    (line,) = summary(judged_elsewhere(frame, said)).to_dict("records")
    assert [line[f"validated_{part}"] for part in ("asked", "n", "rate")] == [3, 2, 0.5]
    assert line["confirmed_asked"] == 0
    assert math.isnan(line["confirmed_rate"])
    (line,) = summary(frame).to_dict("records")
    assert line["validated_asked"] == 0
