"""The report of folders that hold little or nothing, or something wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.analysis.referee import REFEREE, RefereeRow
from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Settings
from ded_bench.problem.benchmark import select_split
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.report.report import write_report
from ded_bench.results.rows import VALIDATED, Results, Row, ValidatedRow
from ded_bench.run.runner import run
from ded_bench.run.tasks import make_tasks
from tests.detailed_cases import MIXED


@pytest.mark.usefixtures("sketched")
def test_nothing_at_all(ninebus: Case, tmp_path: Path) -> None:
    (tmp_path / "empty" / "policies").mkdir(parents=True)
    files = write_report(ninebus, tmp_path / "empty")
    made = pd.read_csv(tmp_path / "empty" / "tables" / "table_v.csv")
    assert made["paper_solve_s"].tolist() == [32.34, 17.34, *[6.8e-4] * 2, 32.38, 18.8, *[6.8e-4] * 2]
    assert (made["n"] == 0).all()
    assert all(path.is_file() for path in files)


@pytest.mark.usefixtures("sketched")
def test_a_case_without_a_paper_has_none_of_its_columns(threebus: Case, tmp_path: Path) -> None:
    """Gaps are to the accurate method; rows of other cases in the folder are not its own."""
    facts = {"objective": 100.0, "feasible": True, "feasible_strict": True, "case": threebus.id}
    rows = [Row("x", "test", "TO", name, "default", "Optimal", **facts) for name in ("ded-slp", "ed")]
    rows[1] = dataclasses.replace(rows[1], objective=103.0)
    Results(tmp_path).add([*rows, dataclasses.replace(rows[0], instance="y", case="elsewhere")])
    write_report(threebus, tmp_path)
    made = pd.read_csv(tmp_path / "tables" / "methods.csv").set_index("method")
    assert made.loc["ed", "gap_percent"] == pytest.approx(3.0)
    assert made.loc["ed", ["rows", "solved", "feasible"]].to_list() == [1, 1, 1]
    text = (tmp_path / "report.md").read_text()
    assert 0 < text.index("keep every limit") < text.index("The methods that were run")
    assert "Table V" not in text


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize("rows", [1, 2])
def test_without_the_reference(threebus: Case, problem: Path, tmp_path: Path, rows: int) -> None:
    """The best feasible schedule is the yardstick, and the first kept schedule is drawn."""
    instances = select_split(problem, "all").instances[:rows]
    tasks = make_tasks(threebus, instances, ["ed"], ["NO"], Settings())
    run(threebus, tasks, Results(tmp_path))
    said: list[str] = []
    write_report(Case.load(problem), tmp_path, said.append)
    text = (tmp_path / "report.md").read_text()
    assert "Nobody ran DED (SLP): gaps are to the best feasible schedule" in text
    assert "(figures/schedule_NO.png)" in text
    assert said[0].startswith("NO: 1 of 1 methods and settings keep every limit")


@pytest.mark.usefixtures("sketched")
def test_verdicts_are_of_the_rows_that_are_there(tmp_path: Path) -> None:
    """Not of those that they replaced; a referee's row that does not say which counts."""
    case = Case.load(SHIPPED_CASES / "two-area")
    facts = {"objective": 1.0, "feasible": True, "feasible_strict": True, "case": case.id}
    rows = [Row(name, "test", "TO", "ed", "default", "Optimal", fingerprint=name, **facts) for name in "abc"]
    results = Results(tmp_path)
    results.add(rows)
    judged = [ValidatedRow(**vars(row) | {"plant": "detailed"}) for row in rows]
    VALIDATED.write(results.paths.validated, [judged[0], dataclasses.replace(judged[1], fingerprint="old")])
    refereed = [
        RefereeRow(**row.key._asdict(), plant="detailed", confirmed=True, row=made_of)
        for row, made_of in zip(rows, ("a", "old", ""), strict=True)
    ]
    REFEREE.write(results.paths.referee, refereed)
    write_report(case, tmp_path)
    made = pd.read_csv(tmp_path / "tables" / "summary.csv").iloc[0]
    assert (made["carried"], made["refereed"]) == ("1 of 1", "2 of 2")


@pytest.mark.usefixtures("sketched")
def test_rows_that_serve_choices_alone_are_no_failures(threebus: Case, tmp_path: Path) -> None:
    row = Row("x", "validation", "TO", "ed", "default", "Optimal", objective=1.0, case=threebus.id)
    Results(tmp_path).add([row])
    write_report(threebus, tmp_path)
    assert "All rows are of validation instances" in (tmp_path / "report.md").read_text()


@pytest.mark.usefixtures("sketched")
def test_an_island_shows_what_frequencies_and_agc_did(tmp_path: Path) -> None:
    """Means of rows, in mHz."""
    case = Case.load(MIXED)
    facts = {"objective": 1.0, "feasible": True, "swing_max_hz": 0.001, "case": case.id, "plant": "detailed"}
    rows = [
        Row(
            name,
            "test",
            "TO",
            "ded-slp",
            "default",
            "Optimal",
            mean_freq_max_hz=peak,
            agc_travel_pu=2.0,
            **facts,
        )
        for name, peak in (("x", 0.004), ("y", 0.006))
    ]
    Results(tmp_path).add(rows)
    write_report(case, tmp_path)
    made = pd.read_csv(tmp_path / "tables" / "methods.csv").iloc[0]
    assert made[["mean_peak_mhz", "swing_peak_mhz", "agc_travel_pu"]].tolist() == pytest.approx(
        [5.0, 1.0, 2.0]
    )
    text = (tmp_path / "report.md").read_text()
    assert 0 < text.index("The methods that were run") < text.index("peak of the mean frequency")


def test_a_folder_without_results_of_the_case_is_refused(threebus: Case, tmp_path: Path) -> None:
    """And nothing is written into it."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no results"):
        write_report(threebus, tmp_path / "empty")
    with pytest.raises(InputError, match="is no folder"):
        write_report(threebus, tmp_path / "typo")
    assert not (tmp_path / "typo").exists()
    assert not list((tmp_path / "empty").iterdir())
    other = Row("x", "test", "TO", "ed", "default", "Optimal", objective=1.0, case="elsewhere")
    Results(tmp_path / "other").add([other])
    with pytest.raises(InputError, match="holds rows of elsewhere, not of"):
        write_report(threebus, tmp_path / "other")


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize("name", ["results.csv", "timing.csv", "certificate.json"])
@pytest.mark.parametrize("text", ["", "a,b\n1,2,3,4\n1\n"])
def test_a_wrong_table_is_bad_input(ninebus: Case, tmp_path: Path, name: str, text: str) -> None:
    """An error, not a gap in the report."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        write_report(ninebus, tmp_path)
    assert name in str(caught.value)
