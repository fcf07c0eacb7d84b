"""The report of folders that hold little or nothing, or something wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.report.report import write_report
from ded_bench.results.rows import Results, Row
from tests.detailed_cases import MIXED


@pytest.mark.usefixtures("sketched")
def test_nothing_at_all(ninebus: Case, problems: Path, tmp_path: Path) -> None:
    (tmp_path / "empty" / "policies").mkdir(parents=True)
    files = write_report(ninebus, tmp_path / "empty", problems)
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
    write_report(threebus, tmp_path, tmp_path / "no-problems")
    made = pd.read_csv(tmp_path / "tables" / "table_v.csv")
    assert not [name for name in made.columns if "paper" in name]
    assert made.set_index("method").loc["ed", "increase_percent"] == pytest.approx(3.0)
    assert "% increase in obj. over DED (SLP)" in (tmp_path / "report.md").read_text()


@pytest.mark.usefixtures("sketched")
def test_an_island_shows_what_frequencies_and_agc_did(tmp_path: Path) -> None:
    """Means of rows, in mHz, before the paper's tables; beside a slack there is no such table."""
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
    write_report(case, tmp_path, tmp_path / "no-problems")
    made = pd.read_csv(tmp_path / "tables" / "island.csv").iloc[0]
    assert made[["mean_peak_mhz", "swing_peak_mhz", "agc_travel_pu"]].tolist() == pytest.approx(
        [5.0, 1.0, 2.0]
    )
    text = (tmp_path / "report.md").read_text()
    assert 0 < text.index("peak of the mean frequency") < text.index("Table V:")


def test_a_folder_without_results_of_the_case_is_refused(threebus: Case, tmp_path: Path) -> None:
    """And nothing is written into it."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no results"):
        write_report(threebus, tmp_path / "empty", tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        write_report(threebus, tmp_path / "typo", tmp_path)
    assert not (tmp_path / "typo").exists()
    assert not list((tmp_path / "empty").iterdir())
    other = Row("x", "test", "TO", "ed", "default", "Optimal", objective=1.0, case="elsewhere")
    Results(tmp_path / "other").add([other])
    with pytest.raises(InputError, match="holds rows of elsewhere, not of"):
        write_report(threebus, tmp_path / "other", tmp_path)


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize(
    "name",
    ["results.csv", "timing.csv", "certificate.json"],
)
@pytest.mark.parametrize("text", ["", "a,b\n1,2,3,4\n1\n"])
def test_a_wrong_table_is_bad_input(
    ninebus: Case, problems: Path, tmp_path: Path, name: str, text: str
) -> None:
    """An error, not a gap in the report."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        write_report(ninebus, tmp_path, problems)
    assert name in str(caught.value)
