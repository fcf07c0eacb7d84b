"""Which method is a case's reference, and where its objectives come from."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ded_bench.evaluate.reference import (
    REFERENCE_ROWS,
    ReferenceRow,
    reference_objectives,
    shipped_table,
)
from ded_bench.evaluate.summary import gaps
from ded_bench.files.errors import InputError
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.problem.sampling import load_manifest
from tests.evaluate.test_summary import frame_of, row

PAPERS = SHIPPED_CASES / "9bus"


def test_the_papers_reference_where_a_case_carries_its_numbers() -> None:
    rows = frame_of(row("a", "ded", 100.0), row("a", "ded-radau", 99.0), row("a", "ed", 110.0))
    found = reference_objectives("9bus", rows)
    assert (found.method, found.run, found.shipped) == ("ded", ("ded", "default"), 0)
    assert gaps(rows, found.objectives)["gap_percent"].to_list() == pytest.approx([0.0, -1.0, 10.0])
    assert reference_objectives("9bus", rows[:0]).method == "ded"


def test_an_accurate_method_elsewhere_whichever_has_scored_rows(tmp_path: Path) -> None:
    ded, slp, radau = row("a", "ded", 100.0), row("a", "ded-slp", 50.0), row("b", "ded-radau", 60.0)
    assert reference_objectives("x", frame_of(ded, slp, radau), tmp_path).method == "ded-radau"
    assert reference_objectives("x", frame_of(ded, slp, row("b", "ded-radau")), tmp_path).method == "ded-slp"
    assert reference_objectives("x", frame_of(ded), tmp_path).method == "ded-radau"
    other = row("b", "ded-radau", 60.0, settings="coarse")
    assert reference_objectives("x", frame_of(ded, slp, other), tmp_path).method == "ded-slp"


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    """A case's folder with objectives for two instances, of the version that its manifest names."""
    shutil.copy(PAPERS / "MANIFEST.json", tmp_path)
    manifest = load_manifest(tmp_path)
    assert manifest
    rows = [("a", 100.0, manifest.version), ("b", 200.0, manifest.version), ("c", 300.0, "0-old")]
    REFERENCE_ROWS.write(
        shipped_table(tmp_path), [ReferenceRow(name, "TO", "ded-radau", j, v) for name, j, v in rows]
    )
    return tmp_path


def test_shipped_objectives_stand_in_where_the_reference_was_not_run(shipped: Path) -> None:
    manifest = load_manifest(shipped)
    assert manifest
    version = {"problems_version": manifest.version}
    rows = frame_of(
        row("a", "ded-radau", 90.0, **version),
        *(row(name, "ed", 99.0, **version) for name in "ac"),
        row("b", "ed", 220.0, **version),
    )
    found = reference_objectives("x", rows, shipped)
    assert (found.method, found.shipped) == ("ded-radau", 1)  # rows before the table; c is of another version
    ours = gaps(rows, found.objectives).query("method == 'ed'").set_index("instance")["gap_percent"]
    assert ours.dropna().to_dict() == {"a": pytest.approx(10.0), "b": pytest.approx(10.0)}
    without = reference_objectives("x", rows.query("method == 'ed'"), shipped)
    assert without.shipped == 2
    copied = rows.assign(problems_version="")  # instances that only bear the same name
    assert reference_objectives("x", copied, shipped).shipped == 0


def test_a_wrong_table_is_named(shipped: Path) -> None:
    shipped_table(shipped).write_text("instance,regime\na,TO\n")
    with pytest.raises(InputError, match=r"reference\.csv"):
        reference_objectives("x", frame_of(row("a", "ed", 1.0)), shipped)
