"""A folder of schedules becomes rows: good files, bad ones and missing ones."""

from __future__ import annotations

import dataclasses
import gzip
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import Selection
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results
from ded_bench.run.runner import submit

pytestmark = pytest.mark.usefixtures("inline")


@pytest.fixture
def chosen(threebus: Case, quiet_instance) -> Selection:
    instances = [(quiet_instance(threebus, id=name, horizon_s=0.2), "test") for name in ("a", "b")]
    return Selection(threebus, tuple(instances), "1-abc")


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return Results(tmp_path / "results")


def text(power: float, horizon: float = 0.2) -> str:
    return f"t,P_plant\n0,{power}\n{horizon},{power}\n"


def put(folder: Path, **files: str) -> Path:
    """Write files; `NO__a` is `a.csv` in the folder `NO`."""
    for name, content in files.items():
        path = folder / (name.replace("__", "/") + ".csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return folder


def test_rows_are_those_of_a_method(chosen, results, tmp_path) -> None:
    folder = put(tmp_path / "mine", a=text(0.6), NO__b=text(0.6), TO__b=text(0.7), c=text(0.6))
    (folder / "a.csv.gz").write_bytes(gzip.compress((folder / "a.csv").read_bytes()))
    (folder / "a.csv").unlink()
    rows, unused = submit(chosen, folder, "mine", ["NO", "TO"], results)
    assert [(row.regime, row.instance) for row in rows] == [
        ("NO", "a"),
        ("NO", "b"),
        ("TO", "a"),
        ("TO", "b"),
    ]
    assert [path.name for path in unused] == ["c.csv"]
    by_key = {(row.regime, row.instance): row for row in Results(results.folder).rows.values()}
    for (regime, name), row in by_key.items():
        instance = next(i for i, _ in chosen.instances if i.id == name)
        power = 0.7 if (regime, name) == ("TO", "b") else 0.6
        schedule = Schedule(np.array([0.0, 0.2]), np.array([[power], [power]]))
        verdict = score(chosen.case, instance, schedule, regime)
        assert row.objective == pytest.approx(verdict.objective, rel=1e-12)
        assert (row.status, row.feasible, row.split) == ("Feasible", verdict.feasible, "test")
        assert (row.method, row.settings, row.problems_version) == ("mine", "default", "1-abc")
        assert row.solve_s is None
        assert results.has_schedule(row)
    assert by_key["TO", "b"].feasible is False  # 0.7 where the instance starts at 0.6


def test_what_is_missing_or_wrong_is_a_failed_row(chosen, results, tmp_path) -> None:
    folder = put(
        tmp_path / "mine", NO__a=text(0.6), TO__a="t,P_plant\n0,0.6\n0.2,oops\n", TO__b=text(0.6, 60)
    )
    rows = {
        (row.regime, row.instance): row for row in submit(chosen, folder, "mine", ["NO", "TO"], results)[0]
    }
    assert rows["NO", "a"].objective is not None
    assert {key: row.status for key, row in rows.items() if row.objective is None} == {
        ("NO", "b"): "Failed",
        ("TO", "a"): "Failed",
        ("TO", "b"): "Failed",
    }
    assert "b.csv: no such schedule" in rows["NO", "b"].error
    assert "a.csv: line 3, P_plant" in rows["TO", "a"].error
    assert "must end at the horizon" in rows["TO", "b"].error
    assert Results(results.folder).rows == results.rows  # they can be read again


def test_one_that_the_grid_cannot_follow_has_no_score(chosen, results, tmp_path) -> None:
    folder = put(tmp_path / "mine", a=text(1e6), b=text(0.6))
    row_a, row_b = submit(chosen, folder, "mine", ["NO"], results)[0]
    assert row_a.error.startswith("scoring failed")
    assert row_b.objective is not None


def test_only_what_changed_is_scored_again(chosen, results, tmp_path, monkeypatch) -> None:
    folder = put(tmp_path / "mine", a=text(0.6), b=text(0.6))
    first = submit(chosen, folder, "mine", ["NO"], results)[0]
    before = results.path.read_bytes()
    monkeypatch.setattr("ded_bench.run.runner.now", lambda: "later")
    assert submit(chosen, folder, "mine", ["NO"], results)[0] == first
    assert results.path.read_bytes() == before
    put(folder, b=text(0.61))
    again = submit(chosen, folder, "mine", ["NO"], results)[0]
    assert again[0] == first[0]
    assert again[1].objective != first[1].objective
    (folder / "b.csv").unlink()
    gone = submit(chosen, folder, "mine", ["NO"], results)[0]
    assert gone[0] == first[0]
    assert gone[1].status == "Failed"
    assert not results.has_schedule(gone[1])  # no stale schedule for a figure to draw
    put(folder, b=text(0.6))
    assert submit(chosen, folder, "mine", ["NO"], results)[0][1].objective == first[1].objective


def test_two_files_for_one_schedule_are_a_question(chosen, results, tmp_path) -> None:
    folder = put(tmp_path / "mine", a=text(0.6), b=text(0.6))
    (folder / "a.csv.gz").write_bytes(gzip.compress(b""))
    row_a, _ = submit(chosen, folder, "mine", ["NO"], results)[0]
    assert "a.csv: is one of two, beside a.csv.gz" in row_a.error


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("ded-ko", "is the name of a method"),
        ("../up", "letters, digits"),
        (".hidden", "letters, digits"),
        ("a/b", "letters, digits"),
        ("", "letters, digits"),
        ("x" * 65, "letters, digits"),
    ],
)
def test_names_that_are_taken_or_unsafe_are_refused(name, told, chosen, results, tmp_path) -> None:
    with pytest.raises(InputError, match=told):
        submit(chosen, put(tmp_path / "mine", a=text(0.6)), name, ["NO"], results)
    assert not results.folder.exists()


def test_a_folder_without_any_of_them_is_refused(chosen, results, tmp_path) -> None:
    with pytest.raises(
        InputError, match=r"mine: has none of the schedules asked for \(such as a.csv or NO/a.csv"
    ):
        submit(chosen, put(tmp_path / "mine", c=text(0.6)), "mine", ["NO"], results)
    with pytest.raises(InputError, match="nowhere: is not a folder"):
        submit(chosen, tmp_path / "nowhere", "mine", ["NO"], results)
    with pytest.raises(InputError, match="unknown regime 'XX'"):
        submit(chosen, tmp_path / "mine", "mine", ["XX"], results)
    with pytest.raises(InputError, match="--split: holds no instance"):
        submit(dataclasses.replace(chosen, instances=()), tmp_path / "mine", "mine", ["NO"], results)
    assert not results.folder.exists()
