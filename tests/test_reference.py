"""The committed reference runs: kept schedules score as rows say, and rows are found again by solving."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from ded_bench.analysis.compare import reproduce
from ded_bench.plants.score import Score, score
from ded_bench.problem.case import REPOSITORY, SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.results.rows import Results

#: Methods whose answer on the paper's grid takes less than a second.
FAST = ("ed", "ded-slp", "ded-ko-knots", "ded-dpc-paper", "ded-dpc", "ded-admm")


def folder(case: str) -> Path:
    """The reference run of a shipped case."""
    return REPOSITORY / "results" / f"{case}-reference"


def instance_of(case: Case, name: str) -> Instance:
    """An instance of a shipped case."""
    return Instance.load_file(SHIPPED_CASES / case.id / "instances" / f"{name}.json", case)[0]


@pytest.mark.parametrize("name", ["9bus", "two-area"])
def test_kept_schedules_score_as_their_rows_say(name: str) -> None:
    """Of every method, settings and regime that keeps some, the first one by its instance."""
    case, results = Case.load(name), Results(folder(name))
    kept = {}
    for row in sorted(results.rows.values(), key=lambda row: row.instance, reverse=True):
        if row.split == "test" and row.objective is not None and results.has_schedule(row):
            kept[row.method, row.settings, row.model, row.regime] = row
    assert len(kept) > 10
    for row in kept.values():
        instance = instance_of(case, row.instance)
        again = score(case, instance, results.schedule(row, case, instance), row.regime)
        assert again.objective == pytest.approx(row.objective, rel=1e-9, abs=0), row.key
        for field in set(Score.__dataclass_fields__) - {"objective"}:
            told = getattr(row, field)  # None: a number of islands only
            known = told if told is None else pytest.approx(told, rel=0, abs=1e-9)
            assert getattr(again, field) == known, row.key


@pytest.mark.usefixtures("inline")
def test_rows_are_found_again() -> None:
    """One of each fast method, settings, model and regime on the paper's grid, solved with today's code."""
    case, results = Case.load("9bus"), Results(folder("9bus"))
    instances = {row.instance: None for row in results.rows.values() if row.split == "test"}
    known = {name: instance_of(case, name) for name in instances}
    said: list[str] = []
    lines = reproduce(case, known, results, FAST, sample=1, tell=said.append)
    assert set(lines["method"]) == set(FAST)
    assert lines["differ"].sum() == 0, said
    assert lines["rows"].sum() >= len(lines) - len(said)


def test_readme_has_the_numbers_of_the_rows() -> None:
    """Its tables are those that `studies/readme.py` makes of the reference runs."""
    page = REPOSITORY / "README.md"
    made = runpy.run_path(str(REPOSITORY / "studies" / "readme.py"))
    text = page.read_text(encoding="utf-8")
    assert made["filled"](text) == text
