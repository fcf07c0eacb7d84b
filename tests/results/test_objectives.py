"""Objectives that a reference run leaves for those who do not have its rows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.results import folder
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.rows import OBJECTIVES, Objective, Results, Row, objectives_of, reference_objectives

RUNS = sorted(path.parent for path in (REPOSITORY / "results").glob("*-reference/results.csv"))
ROW = Row(
    *("a-0001", "test", "NO", "ded", "default", "Optimal"), objective=2.5, case="a", problems_version="1"
)


def test_default_settings_only_and_no_instances_that_served_choices() -> None:
    other = dataclasses.replace(ROW, method="ed", objective=3.0)
    left_out = [
        dataclasses.replace(ROW, settings="accelerated=on"),
        dataclasses.replace(ROW, method="ded-ko", model="koopman@f00"),
        dataclasses.replace(ROW, split="validation"),
        dataclasses.replace(ROW, instance="a-0002", objective=None, error="failed"),
    ]
    found = objectives_of([other, *left_out, ROW])
    assert found == [
        Objective("a", "a-0001", "NO", "ded", 2.5, "1"),
        Objective("a", "a-0001", "NO", "ed", 3.0, "1"),
    ]


def test_of_rows_with_several_time_limits_the_newest_counts() -> None:
    dates = "2026-01-02T00:00:00Z", "2026-01-01T00:00:00Z"
    new, old = (dataclasses.replace(ROW, date=date) for date in dates)
    rows = [new, dataclasses.replace(old, objective=3.0, time_limit_s=1.0)]
    assert objectives_of(rows) == objectives_of(rows[:1])


def test_a_case_has_those_of_its_reference_run(threebus: Case, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(folder, "REFERENCE_RUNS", tmp_path)
    assert reference_objectives(threebus) == []
    path = ResultsFolder(tmp_path / "threebus-reference").objectives
    OBJECTIVES.write(path, objectives_of([ROW]))
    assert reference_objectives(threebus) == objectives_of([ROW])
    path.write_text(path.read_text().replace("2.5", "cheap"))
    with pytest.raises(InputError, match="line 2, objective: 'cheap'"):
        reference_objectives(threebus)


@pytest.mark.parametrize("folder", RUNS, ids=lambda folder: folder.name)
def test_committed_tables_follow_from_the_rows(folder: Path) -> None:
    assert OBJECTIVES.read(ResultsFolder(folder).objectives) == objectives_of(Results(folder).rows.values())


@pytest.mark.parametrize("folder", RUNS, ids=lambda folder: folder.name)
def test_committed_rows_of_success_have_a_score(folder: Path) -> None:
    """Or say why they have none."""
    rows = [row for row in Results(folder).rows.values() if row.status in ("Optimal", "Feasible", "Policy")]
    assert rows
    assert not [row.key for row in rows if row.objective is None and not row.error]


def test_models_are_looked_for_in_the_given_folder_first(threebus: Case, tmp_path: Path, monkeypatch) -> None:
    """Then in the default results folder, then in the reference run; each once."""
    monkeypatch.setattr(folder, "REFERENCE_RUNS", REPOSITORY / "results")
    own, default = tmp_path / "own", Path("results/threebus")
    last = REPOSITORY / "results" / "threebus-reference"
    assert folder.search_folders(threebus, own) == (own, default, last)
    assert folder.search_folders(threebus, default) == (default, last)
