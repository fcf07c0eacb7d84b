"""The sentences of a report's first screen, on rows whose answers are plain."""

from __future__ import annotations

import pandas as pd

from ded_bench.analysis.paper_numbers import Paper
from ded_bench.problem.case import Case
from ded_bench.report.findings import findings
from ded_bench.report.paper import Line, paper_lines
from tests.evaluate.test_summary import DED, frame_of, row, with_gaps
from tests.report.test_paper import PAPER, times


def lines_of(frame: pd.DataFrame, paper: Paper | None = None) -> list[Line]:
    """DED takes 5 s, DED-KO 0.1 s, static dispatch 1 ms."""
    timing = times(("ded", 5.0, 0), ("ded-ko", 0.1, 0), ("ed", 1e-3, 0))
    return paper_lines(with_gaps(frame), timing, paper, DED)


def test_the_fastest_that_keeps_every_limit_and_who_claims_too_much(ninebus: Case) -> None:
    wrong = {"feasible": False, "freq_violation_hz": 3e-3}
    good = (row("a", "ded", 100.0), row("a", "ded-ko", 101.0))
    fast, claims, nearest = findings(ninebus, lines_of(frame_of(*good, row("a", "ed", 99.0, **wrong))), "DED")
    assert fast == (
        "**Fast and feasible:** in TO (|ω| ≤ 0.0016 Hz), DED-KO is the fastest method whose schedules keep "
        "every limit on all 1 instances: 100 ms and a mean gap of +1 % to DED, 50 times faster than that."
    )
    assert "differ most for ED in TO" in claims
    assert "success on 100% of the instances and is feasible on 0%" in claims
    assert "by up to 0.003 Hz" in claims
    assert nearest.endswith("that keep every limit, DED-KO in TO, +1 % on 1 instance.")


def test_a_method_that_was_asked_little_is_not_the_nearest(ninebus: Case) -> None:
    both = [row(i, m, cost) for i in "ab" for m, cost in (("ded", 100.0), ("ded-ko", 101.0))]
    lucky = row("a", "ed", 100.0)
    nearest = findings(ninebus, lines_of(frame_of(*both, lucky)), "DED")[-1]
    assert "DED-KO in TO, +1 % on 2 instances" in nearest


def test_claims_that_hold_and_cells_behind_the_paper(ninebus: Case) -> None:
    frame = frame_of(row("a", "ded", 100.0), row("a", "ded-ko", 101.0))
    _, claims, paper = findings(ninebus, lines_of(frame, PAPER), "DED")
    assert claims.endswith("every schedule that its method claims is feasible.")
    assert paper.endswith("cells of both tables are ahead of its numbers; behind: DED-KO TO.")


def test_nobody_keeps_every_limit_and_nothing_to_say(ninebus: Case) -> None:
    frame = frame_of(row("a", "ed", 99.0, feasible=False, freq_violation_hz=1e-3))
    assert "no timed method keeps every limit" in findings(ninebus, lines_of(frame), "DED")[0]
    assert findings(ninebus, lines_of(frame_of()), "DED") == []
