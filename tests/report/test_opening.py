"""The sentences of a report's first screen, on rows whose answers are plain."""

from __future__ import annotations

import pandas as pd

from ded_bench.analysis.paper_numbers import result_lines
from ded_bench.problem.case import Case
from ded_bench.report.sections.opening import findings
from tests.analysis.test_summary import frame_of, row, with_gaps
from tests.report.test_paper_tables import times


def lines_of(frame: pd.DataFrame) -> pd.DataFrame:
    """DED takes 5 s, DED-KO 0.1 s, static dispatch 1 ms."""
    timing = times(("ded", 5.0, 0), ("ded-ko", 0.1, 0), ("ed", 1e-3, 0))
    return result_lines(with_gaps(frame), timing, None, "ded")


def test_the_fastest_that_keeps_every_limit_and_who_claims_too_much(ninebus: Case) -> None:
    wrong = {"feasible": False, "freq_violation_hz": 3e-3}
    good = (row("a", "ded", 100.0), row("a", "ded-ko", 101.0))
    fast, claims = findings(ninebus, lines_of(frame_of(*good, row("a", "ed", 99.0, **wrong))), "DED")
    assert "DED-KO is the fastest" in fast
    assert fast.endswith(": 100 ms and a mean gap of +1 % to DED, 50 times faster than that.")
    assert "differ most for ED in TO" in claims
    assert "success on 100% of the instances and is feasible on 0%" in claims
    assert "by up to 0.003 Hz" in claims


def test_nobody_keeps_every_limit_and_nothing_to_say(ninebus: Case) -> None:
    frame = frame_of(row("a", "ed", 99.0, feasible=False, freq_violation_hz=1e-3))
    assert "no timed method keeps every limit" in findings(ninebus, lines_of(frame), "DED")[0]
    assert findings(ninebus, lines_of(frame_of()), "DED") == []
