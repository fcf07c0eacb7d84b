"""The paper's tables, on small tables with answers worked out by hand, and the file of its numbers."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.analysis.reference import Paper, read_paper, result_lines
from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.report.columns import TABLE_V, TABLE_VI, Column, tabulate
from tests.analysis.test_summary import NO_TIMES, frame_of, row, table, with_gaps

__all__ = ["table"]

FILE = SHIPPED_CASES / "9bus" / "paper.json"
PAPER = parse_record(Paper, FILE.read_text(encoding="utf-8"), FILE)
#: Ours that answer to a row of the paper, in its order.
OURS = ["ded", "ded-ko", "ded-dpc-paper", "ded-dpc"]


def times(*rows: tuple[str, float, int]) -> pd.DataFrame:
    """The timing table of regime TO: method, median, failures."""
    cells = [("TO", method, "default", "", seconds, failures) for method, seconds, failures in rows]
    return pd.DataFrame(cells, columns=NO_TIMES.columns)


def made(columns: tuple[Column, ...], frame: pd.DataFrame, timing: pd.DataFrame = NO_TIMES) -> pd.DataFrame:
    """A table by regime, method and settings."""
    lines = result_lines(with_gaps(frame), timing, PAPER, "ded")
    if columns is TABLE_VI:
        lines["n"] = lines["rows"] - lines["failures"]
    return tabulate(columns, lines).set_index(["regime", "method", "settings"])


def test_table_v_puts_the_papers_numbers_beside_ours(table: pd.DataFrame) -> None:
    ours = made(TABLE_V, table, times(("ded", 5.0, 0), ("ded-ko", 30.0, 0)))
    ded, ko = ours.loc[("TO", "ded", "default")], ours.loc[("TO", "ded-ko", "default")]
    assert math.isnan(ded["increase_percent"])  # NA, as in the paper
    assert (ded["solve_s"], ded["paper_solve_s"], ded["against_paper_time"]) == (5.0, 32.38, "ahead")
    assert ded["against_paper_increase"] == ""
    assert ko["increase_percent"] == pytest.approx(4 / 3)
    assert (ko["paper_increase_percent"], ko["n"], ko["failures"]) == (0.3, 3, 1)
    assert (ko["against_paper_increase"], ko["against_paper_time"]) == ("behind", "behind")


def test_a_method_with_failures_is_never_ahead() -> None:
    rows = [row("a", "ded", 100.0), row("b", "ded", 100.0), row("a", "ded-ko", 100.1)]
    key = ("TO", "ded-ko", "default")
    whole = made(TABLE_V, frame_of(*rows), times(("ded-ko", 1.0, 0))).loc[key]
    assert (whole["against_paper_increase"], whole["against_paper_time"]) == ("ahead", "ahead")
    failed = made(TABLE_V, frame_of(*rows, row("b", "ded-ko")), times(("ded-ko", 1.0, 1))).loc[key]
    assert (failed["against_paper_increase"], failed["against_paper_time"]) == ("behind", "behind")


def test_what_was_not_run_is_an_empty_row_beside_the_papers() -> None:
    for frame in (frame_of(), frame_of(row("a", "ded", 1.0))):
        for columns in (TABLE_V, TABLE_VI):
            ours = made(columns, frame)
            assert list(ours.index) == [(regime, name, "default") for regime in ("NO", "TO") for name in OURS]
            missing = ours.loc[("NO", "ded-ko", "default")]
            assert (missing["n"], missing["failures"]) == (0, 0)
    assert made(TABLE_V, frame_of()).loc[("NO", "ded-dpc-paper", "default"), "paper_increase_percent"] == 1.05


def test_table_vi_means_the_maxima_and_knows_equal(table: pd.DataFrame) -> None:
    ko = made(TABLE_VI, table).loc[("TO", "ded-ko", "default")]
    assert ko["freq_violation_hz"] == pytest.approx((2e-4 + 1e-5) / 4)
    assert (ko["n"], ko["failures"], ko["against_paper_frequency"]) == (4, 1, "behind")
    same = frame_of(row("a", "ded", 1.0, regime="NO", ramp_violation=1.84e-9))
    ded = made(TABLE_VI, same).loc[("NO", "ded", "default")]
    assert (ded["against_paper_frequency"], ded["against_paper_ramp"]) == ("equal", "equal")


def test_the_papers_numbers_lie_beside_its_case_only(ninebus: Case, tmp_path: Path) -> None:
    assert read_paper(FILE.parent) == PAPER
    assert PAPER.case_fingerprint == ninebus.fingerprint
    assert set(PAPER.regimes) == set(ninebus.regimes)
    assert read_paper(tmp_path) is None


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"source": None}, "source"),
        ({"more": 1}, "more"),
        ({"regimes": {"NO": {"DED": {"solve_s": 1.0}}}}, "increase_percent"),
        ({"regimes": {"odd": {}}}, "regimes"),
        ({"regimes": {"NO": {"DED-KO": PAPER.regimes["NO"]["DED-KO"].model_dump()}}}, "regimes"),
        ({"regimes": {"NO": {"DED-X": PAPER.regimes["NO"]["DED"].model_dump()}}}, "regimes.NO.DED-X"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, change, field: str) -> None:
    data = json.loads(FILE.read_text(encoding="utf-8"))
    (tmp_path / "paper.json").write_text(json.dumps(data | change))
    with pytest.raises(InputError) as caught:
        read_paper(tmp_path)
    assert "paper.json" in str(caught.value)
    assert field in str(caught.value)
