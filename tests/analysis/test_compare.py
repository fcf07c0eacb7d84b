"""Two results folders side by side: what counts as a change."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from ded_bench.analysis.compare import compare, limits, to_json, to_text
from ded_bench.files.errors import InputError
from ded_bench.results.rows import Results, Row
from tests.analysis import test_summary


def row(instance: str, method: str = "ded-radau", objective: float | None = 100.0, **changes) -> Row:
    facts = {"solve_s": 2.0, "freq_violation_hz": 2e-5, "feasible_strict": False}
    facts |= {"problems_version": "1-abc", "version": "0.1.0", "case": "grid"}
    return test_summary.row(instance, method, objective, **(facts | changes))


BASE = [row("a"), row("b"), row("a", "mine", 101.0, solve_s=0.1), row("b", "mine", 103.0, solve_s=0.1)]


@pytest.fixture
def folders(tmp_path: Path):
    """`folders(rows_of_b)`: the base as A beside these rows as B."""

    def make(rows: list[Row], base: list[Row] = BASE) -> tuple[Path, Path]:
        for name, table in (("A", base), ("B", rows)):
            (tmp_path / name).mkdir()
            Results(tmp_path / name).add(table)
        return tmp_path / "A", tmp_path / "B"

    return make


def altered(index: int, **changes) -> list[Row]:
    rows = list(BASE)
    rows[index] = dataclasses.replace(rows[index], **changes)
    return rows


def test_equal_folders_agree_whatever_the_times(folders) -> None:
    slower = [
        dataclasses.replace(r, solve_s=r.solve_s * 3, date="2030", host="other", iterations=9) for r in BASE
    ]
    found = compare(*folders(slower))
    assert found.same
    assert found.common == 4
    assert to_text(found).splitlines()[-1] == "A and B agree on 4 common rows"


@pytest.mark.parametrize(
    ("changes", "column"),
    [
        ({"status": "Failed"}, "status"),
        ({"feasible": False}, "feasible"),
        ({"feasible": None}, "feasible"),
        ({"objective": 101.0 * (1 + 1.1e-6)}, "objective"),
        ({"objective": 101.0 * (1 - 1.1e-6)}, "objective"),
        ({"objective": None}, "objective"),
        ({"freq_violation_hz": 2.2e-5}, "freq_violation_hz"),
        ({"ramp_violation": 1.1e-8}, "ramp_violation"),
        ({"bound_violation": 1.1e-8}, "bound_violation"),
        ({"initial_violation": None}, "initial_violation"),
    ],
)
def test_changes_beyond_the_tolerance_are_told(folders, changes, column) -> None:
    found = compare(*folders(altered(2, **changes)))
    assert not found.same
    (change,) = found.changes
    assert (change.column, change.key.instance, change.key.method) == (column, "a", "mine")
    assert change.after == changes[column]
    text = to_text(found)
    assert f"{column}: 1 of 4 common rows\n  a TO mine: " in text
    assert text.endswith(f"A and B differ: 1 × {column}\n")


@pytest.mark.parametrize(
    "changes",
    [
        {"objective": 101.0 * (1 + 0.9e-6)},
        {"freq_violation_hz": 2e-5 + 0.9e-6},
        {"ramp_violation": 0.9e-8, "bound_violation": 0.9e-8},
        {"feasible_strict": True, "solver_objective": 7.0, "fingerprint": "other"},
    ],
)
def test_changes_within_it_are_none(folders, changes) -> None:
    assert compare(*folders(altered(2, **changes))).same


def test_tolerances_are_the_callers(folders) -> None:
    pair = folders(altered(2, objective=102.0, freq_violation_hz=1e-3, ramp_violation=1e-5))
    assert compare(*pair, limits(0.02, 1e-2, 1e-4)).same
    assert [c.column for c in compare(*pair, limits(0.02, 1e-2, 0.0)).changes] == ["ramp_violation"]
    assert compare(*pair, limits(objective=0.0)).changes[0].size == pytest.approx(1 / 102)


def test_rows_of_one_folder_only_count_unless_told_otherwise(folders) -> None:
    pair = folders([*BASE[:3], row("c")])
    found = compare(*pair)
    assert [key.instance for key in found.only_a] == ["b"]
    assert [key.instance for key in found.only_b] == ["c"]
    assert "only in A: 1 rows\n  b TO mine\n" in to_text(found)
    assert not found.same
    assert compare(*pair, common_only=True).same


def test_a_comparison_is_one_json_object(folders) -> None:
    changed = [dataclasses.replace(BASE[0], objective=None), *BASE[1:3]]
    found = json.loads(to_json(compare(*folders(changed))))
    assert (found["same"], found["common"], len(found["only_a"]), found["only_b"]) == (False, 3, 1, [])
    [lost] = [change for change in found["changes"] if change["column"] == "objective"]
    assert (lost["instance"], lost["before"], lost["after"], lost["size"]) == ("a", 100.0, None, None)


def test_other_problems_cannot_be_compared(folders) -> None:
    found = compare(*folders([dataclasses.replace(r, problems_version="1-def", objective=1.0) for r in BASE]))
    assert not found.same
    assert found.changes == ()
    assert (
        "4 common rows are of different problems, such as a TO ded-radau: grid 1-abc in A, grid 1-def in B"
        in (found.incomparable)
    )
    assert to_text(found).splitlines()[-1].startswith("not comparable: ")


def test_a_folder_without_rows_is_bad_input(folders, tmp_path) -> None:
    a, _ = folders(BASE)
    with pytest.raises(InputError, match=r"nowhere.results.csv: is missing"):
        compare(a, tmp_path / "nowhere")
    (tmp_path / "nowhere").mkdir()
    (tmp_path / "nowhere" / "results.csv").write_text("instance,regime\n")
    with pytest.raises(InputError, match="split: required column is missing"):
        compare(tmp_path / "nowhere", a)
