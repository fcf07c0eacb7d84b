"""Kept schedules, scored again: what agrees, what does not, and what cannot be checked."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import VALIDATED, Results, Row
from ded_bench.run import scoring
from ded_bench.run.scoring import rescore, scored_row, validate

pytestmark = pytest.mark.usefixtures("inline")


@pytest.fixture
def instances(threebus: Case, quiet_instance) -> dict[str, Instance]:
    return {name: quiet_instance(threebus, id=name, horizon_s=0.2) for name in "abcd"}


@pytest.fixture
def results(threebus: Case, instances: dict[str, Instance], tmp_path: Path) -> Results:
    """Four scored rows in TO; all but the last one's schedules are kept."""
    results = Results(tmp_path)
    for i, (name, instance) in enumerate(instances.items()):
        power = instance.p_initial(threebus)
        schedule = Schedule(np.array([0.0, 0.2]), np.array([power, power + 0.001 * i]))
        row = Row(name, "test", "TO", "ded", "default", "Optimal", case="threebus", fingerprint="f")
        row = scored_row(row, score(threebus, instance, schedule, "TO"))
        results.keep(row, schedule if name != "d" else None, threebus)
    return results


def row_of(results: Results, name: str) -> Row:
    return next(row for row in results.rows.values() if row.instance == name)


def test_rows_that_agree_and_rows_without_a_schedule(threebus: Case, instances, results) -> None:
    rows, differences = rescore(threebus, instances, results)
    assert [row.instance for row in rows] == ["a", "b", "c"]
    assert differences == []
    del instances["b"]
    assert [row.instance for row in rescore(threebus, instances, results)[0]] == ["a", "c"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"objective": 1.0 + 1e-8}, "objective"),
        ({"freq_violation_hz": 2e-9}, "freq_violation_hz"),
        ({"ramp_violation": 2e-9}, "ramp_violation"),
        ({"bound_violation": None}, "bound_violation None in the row"),
        ({"feasible": False}, "feasible or feasible_strict"),
        ({"objective": None, "error": "scoring failed: no idea"}, "(scoring failed: no idea)"),
    ],
)
def test_a_row_that_differs_is_named(change: dict, said: str, threebus: Case, instances, results) -> None:
    row = row_of(results, "b")
    if change.get("objective"):
        change = {"objective": row.objective * change["objective"]}
    elif "error" not in change:
        change = {name: value and value + getattr(row, name) for name, value in change.items()}
        change |= {"feasible": False} if "feasible" in change else {}
    results.add([dataclasses.replace(row, **change)])
    heard: list[str] = []
    _, differences = rescore(threebus, instances, results, on_difference=heard.append)
    assert differences == heard
    (difference,) = differences
    assert difference.startswith("ded default TO b: ")
    assert said in difference


def test_rounding_is_no_difference(threebus: Case, instances, results) -> None:
    row = row_of(results, "b")
    change = {"objective": row.objective * (1 + 5e-10), "ramp_violation": row.ramp_violation + 5e-10}
    results.add([dataclasses.replace(row, **change)])
    assert rescore(threebus, instances, results)[1] == []


def test_a_schedule_that_is_damaged_or_another_is_a_difference(threebus: Case, instances, results) -> None:
    a, c = row_of(results, "a"), row_of(results, "c")
    (results.archive(a).path.with_suffix("") / f"{a.member}.npy").write_bytes(b"no schedule")
    other = Schedule(np.array([0.0, 0.2]), np.array([[0.6], [0.7]]))
    results.archive(c).write(c.member, other, threebus)
    _, differences = rescore(threebus, instances, results)
    assert "scoring failed" in next(line for line in differences if " TO a: " in line)
    assert {line.split(": ")[0] for line in differences} == {"ded default TO a", "ded default TO c"}
    rescore(threebus, instances, results, update=True)
    assert row_of(results, "a") == a  # what cannot be read takes no score away


def test_update_scores_anew_what_is_kept(threebus: Case, instances, results: Results) -> None:
    rescore(threebus, instances, results, update=True)
    right = dict(results.rows)
    old = dataclasses.replace(row_of(results, "b"), objective=1.0)
    empty = dataclasses.replace(row_of(results, "c"), objective=None, feasible=None)
    results.add([old, empty])
    _, differences = rescore(threebus, instances, results, update=True)
    assert [line.split(":")[0] for line in differences] == ["ded default TO b", "ded default TO c"]
    assert Results(results.folder).rows == right
    assert len(results.path.read_text().splitlines()) == 5


def test_nothing_to_check_is_an_error(threebus: Case, instances, results) -> None:
    with pytest.raises(InputError, match=r"schedules: holds no schedule of these rows"):
        rescore(threebus, {"d": instances["d"]}, results)


def test_other_plants_have_a_table_of_their_own(
    threebus: Case, instances, results, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line per row and plant, as often as one asks; the rows stay as they are."""
    before = results.path.read_bytes()
    for _ in range(2):
        rows = validate(threebus, instances, results, "lossless")
        assert [row.key for row in rows] == [(row_of(results, name).key, "lossless") for name in "abc"]
        assert [row.objective for row in rows] == [row_of(results, name).objective for name in "abc"]
        assert VALIDATED.read(results.paths.validated) == rows
    assert results.path.read_bytes() == before
    kept, died = results.paths.validated.read_bytes(), RuntimeError("the process died")
    monkeypatch.setattr(scoring, "verdicts", lambda *_: [(row_of(results, name), died) for name in "abc"])
    assert {row.objective for row in validate(threebus, instances, results, "lossless")} == {None}
    assert results.paths.validated.read_bytes() == kept  # that says nothing of a schedule
