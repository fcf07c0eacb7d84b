"""The part on the AC network stands where schedules were scored there, and nowhere else."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from ded_bench.problem.case import Case
from ded_bench.report.ac_section import ac_blocks, ac_tables
from ded_bench.report.page import Items, render_markdown
from ded_bench.run.ac_scoring import AcResults, AcRow
from ded_bench.run.results import ROWS, Results, Row


def gallery_of(results: Results, case: Case) -> Any:
    rows = ROWS.frame(results.rows.values())
    return SimpleNamespace(sources=SimpleNamespace(case=case, results=results, rows=rows))


def test_validated_rows(tmp_path):
    case, results = Case.load("two-area"), Results(tmp_path)
    rows = [
        Row(
            name, "test", "TO", "ded", "default", "Optimal", objective=1.0, feasible=True, case=case.id,
            fingerprint="f",
        )
        for name in "ab"
    ]  # fmt: skip
    results.add(rows)
    assert ac_blocks(gallery_of(results, case)) == []
    scores = [
        AcRow("a", "TO", "ded", "default", 2.0, 3e-3, feasible=False, case=case.id, fingerprint="f"),
        AcRow(
            "b", "TO", "ded", "default", error="scoring failed: no solution", case=case.id, fingerprint="f"
        ),
    ]
    AcResults(tmp_path).add(scores)
    gallery = gallery_of(results, case)
    assert ac_tables(gallery)["validated"].frame["only_verified"].tolist() == [1.0]
    blocks = ac_blocks(gallery)
    [items] = [block for block in blocks if isinstance(block, Items)]
    assert any("Of 2 instances the AC network can carry 1" in text for text in items.items)
    assert "| TO | DED | 1 | 100 % | 100 % | 0 % |" in " ".join(render_markdown(blocks).split())
