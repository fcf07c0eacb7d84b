"""The report of folders that hold little or nothing, or something wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.analysis.certificate import Certificate, save_certificate
from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.report.report import write_report
from ded_bench.results.rows import Results, Row


@pytest.mark.usefixtures("sketched")
def test_nothing_at_all(ninebus: Case, problems: Path, tmp_path: Path) -> None:
    (tmp_path / "empty" / "policies").mkdir(parents=True)
    files = write_report(ninebus, tmp_path / "empty", problems)
    text = (tmp_path / "empty" / "report.md").read_text()
    assert "No rows yet" in text
    assert "ded-bench solve" in text
    assert "run `ded-bench bench`" in text
    assert "`ded-bench train-dpc` trains one" in text
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
    text = (tmp_path / "report.md").read_text()
    assert "The problem files cannot be read" in text
    assert "gaps are to DED (SLP)" in text
    made = pd.read_csv(tmp_path / "tables" / "table_v.csv")
    assert not [name for name in made.columns if "paper" in name]
    assert made.set_index("method").loc["ed", "increase_percent"] == pytest.approx(3.0)
    assert "% increase in obj. over DED (SLP)" in text


@pytest.mark.usefixtures("sketched")
def test_why_there_is_no_gap(threebus: Case, tmp_path: Path) -> None:
    facts = {"case": threebus.id, "problems_version": "1-x"}
    row = Row("x", "test", "TO", "ed", "default", "Optimal", objective=1.0, **facts)
    Results(tmp_path).add([row])
    write_report(threebus, tmp_path, tmp_path / "no-problems")
    text = (tmp_path / "report.md").read_text()
    assert "> **Note:** No gap can be given: gaps are to DED (Radau), which has no scored row" in text
    assert "problem version 1-x" in text
    Results(tmp_path).add([dataclasses.replace(row, objective=None, status="Failed")])
    write_report(threebus, tmp_path, tmp_path / "no-problems")
    assert "> **Note:** No row has a score" in (tmp_path / "report.md").read_text()


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
def test_certificate_is_shown(ninebus: Case, problems: Path, tmp_path: Path) -> None:
    facts = {
        "case": "9bus",
        "method": "ded-dpc",
        "reference": "ded-ko-knots",
        "regime": "TO",
        "settings": "default",
        "seed": 2_000_000,
        "count": 10_000,
        "successes": 9_950,
        "meets_limits": 9_960,
        "near_reference": 9_970,
        "tolerance_hz": 1e-6,
        "tolerance_pu": 1e-8,
        "gap_percent": 1.0,
        "delta": 0.01,
        "clopper_pearson": 0.9931,
        "hoeffding": 0.9798,
        "artifacts": "abc",
        "version": "0",
        "host": "here",
        "date": "2026-01-01T00:00:00Z",
    }
    save_certificate(tmp_path, Certificate(**facts))
    save_certificate(tmp_path, Certificate(**facts | {"regime": "NO"}))
    save_certificate(tmp_path, Certificate(**facts | {"successes": 9_951}))
    write_report(ninebus, tmp_path, problems)
    text = (tmp_path / "report.md").read_text()
    assert "at least 99.31% of fresh TO instances meet every limit" in text
    assert "| TO | DED-DPC | 10000 | 9951 | 9960 | 9970 | 99.31 % | 97.98 % |" in text
    assert "9950 of 10000" in text  # NO
    assert text.count("of 10000 did") == 2  # the third replaced the first


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize(
    "name",
    ["results.csv", "timing.csv", "policies/p.history.csv", "certificate.json"],
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
