"""The committed reference run: tables follow from its rows, README repeats them, kept schedules score so."""

from __future__ import annotations

import pytest

from ded_bench.evaluate.ablation import main_rows
from ded_bench.problem.case import REPOSITORY, SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.report.columns import TABLE_V, TABLE_VI, tabulate
from ded_bench.report.paper import paper_lines
from ded_bench.report.render import to_markdown
from ded_bench.report.sources import read_sources
from ded_bench.results.rows import Results
from ded_bench.plants.score import Score, score

FOLDER = REPOSITORY / "results" / "9bus-reference"
TABLES = {"table_v": TABLE_V, "table_vi": TABLE_VI}


@pytest.mark.parametrize("name", TABLES)
def test_readme_repeats_the_tables(name: str) -> None:
    """Line by line."""
    table = (FOLDER / "tables" / f"{name}.md").read_text(encoding="utf-8")
    assert table.count("\n") > 2
    assert f"\n\n{table}\n" in (REPOSITORY / "README.md").read_text(encoding="utf-8")


def test_the_tables_follow_from_the_rows(ninebus: Case) -> None:
    """The printed tables are those of results.csv and timing.csv, to the last printed digit."""
    sources = read_sources(ninebus, FOLDER, SHIPPED_CASES / ninebus.id)
    lines = paper_lines(main_rows(sources.judged), sources.timing, sources.paper, sources.reference.run)
    for name, columns in TABLES.items():
        printed = (FOLDER / "tables" / f"{name}.md").read_text(encoding="utf-8")
        assert to_markdown(tabulate(columns, lines), columns) == printed, name


@pytest.fixture(scope="module")
def results() -> Results:
    return Results(FOLDER)


@pytest.mark.parametrize("method", sorted({path.name for path in (FOLDER / "schedules").iterdir()}))
def test_kept_schedules_score_as_their_rows_say(ninebus: Case, results: Results, method: str) -> None:
    """Of every method that keeps some, on the first and the last instance."""
    kept = [
        key for key in sorted(results.rows) if key.method == method and results.schedule_path(key).is_file()
    ]
    for key in (kept[0], kept[-1]):
        path = SHIPPED_CASES / ninebus.id / "instances" / f"{key.instance}.json"
        instance, _ = Instance.load_file(path, ninebus)
        again = score(ninebus, instance, results.schedule(key, ninebus, instance), key.regime)
        row = results.rows[key]
        assert again.objective == pytest.approx(row.objective, rel=1e-9, abs=0), key
        for name in Score.__dataclass_fields__:
            if name != "objective":
                assert getattr(again, name) == pytest.approx(getattr(row, name), rel=0, abs=1e-9), (key, name)
