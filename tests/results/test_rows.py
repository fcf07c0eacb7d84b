"""The results table on disk: nothing lost, nothing twice, bad files named."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import ROWS, SCORING_FAILED, Results, Row

ROW = Row(
    instance="a-1",
    split="test",
    regime="NO",
    method="ded",
    settings="default",
    status="Optimal",
    iterations=3,
    solve_s=0.1 + 0.2,
    feasible=True,
    error='comma, "quote"',
    fingerprint="f",
)


def test_rows_survive_the_file_to_the_last_digit(tmp_path: Path) -> None:
    Results(tmp_path).add([ROW])
    assert ROWS.read(tmp_path / "results.csv") == [ROW]
    assert Results(tmp_path).rows == {ROW.key: ROW}
    frame = Results(tmp_path).frame()
    assert frame["solve_s"].iloc[0] == 0.1 + 0.2
    assert list(frame.columns) == list(ROWS.names)


def test_a_row_is_finished_when_it_is_scored_for_the_same_inputs(threebus: Case, tmp_path: Path) -> None:
    """Its schedule need not be kept, unless it is still to be scored, or scoring it has failed."""
    results = Results(tmp_path)
    plain = dataclasses.replace(ROW, error="", method_version=2)
    scored, told = dataclasses.replace(plain, objective=1.0), dataclasses.replace(plain, error="why")
    failed = dataclasses.replace(plain, error=f"{SCORING_FAILED}why")
    schedule = Schedule(np.array([0.0, 1.0]), np.array([[0.5], [0.5]]))
    cases = (scored, True, True), (plain, False, False), (told, False, False), (failed, False, True)
    for row, alone, with_schedule in cases:
        results.keep(row, None, threebus)  # the schedule of the one before goes
        assert results.finished(row.key, "f") is alone
        results.keep(row, schedule, threebus)
        assert results.finished(row.key, "f", 2) is with_schedule
        assert not results.finished(row.key, "another fingerprint")
        assert not results.finished(row.key, "f", 3)  # made by an older version of the method
    assert not results.finished(row.key._replace(model="koopman@f00"), "f")


def test_schedules_are_packed_once_their_rows_are_there(threebus: Case, tmp_path: Path) -> None:
    """Those of several models side by side; the schedule of a row that is replaced goes."""
    results = Results(tmp_path)
    schedule = Schedule(np.array([0.0, 1.0]), np.array([[0.5], [0.5]]))
    rows = [ROW, dataclasses.replace(ROW, model="koopman@f00", fingerprint="g")]

    def interrupted() -> None:
        with results.packed():
            for row in rows:
                results.keep(row, schedule, threebus)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    place = tmp_path / "schedules" / "ded" / "default"
    assert [path.name for path in place.iterdir()] == ["NO.npz"]
    with results.packed():
        results.keep(dataclasses.replace(ROW, fingerprint="h"), schedule, threebus)
    with np.load(place / "NO.npz", allow_pickle=False) as archive:
        assert set(archive) == {"columns", "a-1-g", "a-1-h"}


GOOD = ROWS.format([ROW])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (GOOD.replace("status", "state"), "status: required column is missing"),
        (GOOD.replace("Optimal", "Splendid"), "line 2, status"),
        (GOOD.replace("a-1", "../../a"), "line 2, instance"),
    ],
)
def test_wrong_tables_are_refused_with_line_and_column(text: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        Results(tmp_path)
    assert str(path) in str(caught.value)
    assert named in str(caught.value)


@pytest.mark.parametrize("ending", [b"", b"\n", b"\r\n\n"])
def test_a_mark_and_blank_lines_of_an_editor_are_accepted(tmp_path: Path, ending: bytes) -> None:
    """Also where rows are added after them."""
    row = Row(*("x-0", "test", "NO", "ded", "default", "Optimal"), objective=1.0, case="x")
    path = Results(tmp_path).path
    Results(tmp_path).add([row])
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes() + ending)
    opened = Results(tmp_path)
    opened.add([dataclasses.replace(row, instance="x-1")])
    assert [r.instance for r in Results(tmp_path).rows.values()] == ["x-0", "x-1"]
    assert opened.rows == Results(tmp_path).rows
