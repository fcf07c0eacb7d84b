"""The results table on disk: nothing lost, nothing twice, bad files named."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.run.results import COLUMNS, Key, Results, Row, format_rows, read_rows

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
    error='comma, "quote"\nand line',
    fingerprint="f",
)


def test_rows_survive_the_file_to_the_last_digit(tmp_path: Path) -> None:
    Results(tmp_path).add([ROW])
    assert read_rows(tmp_path / "results.csv") == [ROW]
    assert Results(tmp_path).rows == {ROW.key: ROW}
    frame = Results(tmp_path).frame()
    assert frame["solve_s"].iloc[0] == 0.1 + 0.2
    assert list(frame.columns) == list(COLUMNS)


def test_a_row_counts_only_with_its_schedule_and_fingerprint(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.add([ROW])
    assert not results.has(ROW.key, "f")
    path = results.schedule_path(ROW.key)
    path.parent.mkdir(parents=True)
    path.touch()
    assert results.has(ROW.key, "f")
    assert not results.has(ROW.key, "another fingerprint")
    assert not results.has(Key("a-2", "NO", "ded", "default"), "f")


def _add(folder: str, first: int) -> None:
    import dataclasses

    results = Results(folder)
    for i in range(first, first + 20):
        results.add([dataclasses.replace(ROW, instance=f"a-{i}")])


def test_two_writers_lose_no_row(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_add, args=(str(tmp_path), first)) for first in (0, 100)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert len(Results(tmp_path).rows) == 40


GOOD = format_rows([ROW])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "instance"),
        (GOOD.replace("solve_s", "solve"), "solve_s"),
        (GOOD.replace(",date", ",date,extra"), "extra"),
        (GOOD.replace("Optimal", "Splendid"), "line 2, status"),
        (GOOD.replace("0.30000000000000004", "nan"), "line 2, solve_s"),
        (GOOD.replace("0.30000000000000004", "fast"), "line 2, solve_s"),
        (GOOD.replace(",True,", ",perhaps,"), "line 2, feasible"),
        (GOOD.replace("a-1", "../../a"), "line 2, instance"),
        (GOOD + "a,b\n", "line 3"),
    ],
)
def test_wrong_tables_are_refused_with_line_and_column(text: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        Results(tmp_path)
    assert str(path) in str(caught.value)
    assert named in str(caught.value)
