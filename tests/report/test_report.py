"""The report of real rows on a short 9-bus benchmark: tables, page, and everything that may be missing."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ded_bench.files.arrays import write_arrays
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import load_split
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.report.columns import TABLE_V, TABLE_VI
from ded_bench.report.figures.panels import representative
from ded_bench.report.report import write_report
from ded_bench.report.sources import read_sources
from ded_bench.results.rows import Results, Row
from ded_bench.results.timing import TIMING, TimingRow
from ded_bench.run.scoring import scored_row
from tests.reading import Page
from tests.report.conftest import TEST

METHODS = {"ded": 0.05, "ded-ko": 1.0, "ded-dpc-paper": 5.0}


def dispatch(case: Case, instance: Instance, lag: float) -> Schedule:
    """Follow the static dispatch with a lag at the ramp limit: cheaper the shorter the lag."""
    target = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), instance.p_load(case))
    p = np.empty_like(target)
    p[0] = instance.p_initial(case)
    most = case.ramp_pu_per_s * instance.dt_s
    for k in range(len(p) - 1):
        p[k + 1] = p[k] + np.clip((target[k + 1] - p[k]) * instance.dt_s / lag, -most, most)
    return Schedule(instance.grid, p)


@pytest.fixture(scope="module")
def finished(ninebus: Case, problems: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with scored schedules of three methods in both regimes, one failure, and times."""
    results = Results(tmp_path_factory.mktemp("results"))
    split = load_split(problems)
    version = json.loads((problems / "MANIFEST.json").read_text())["version"]
    facts = {"problems_version": version, "version": "1", "host": "h", "date": "2026-01-01T00:00:00Z"}
    facts |= {"case": "9bus", "seed": "3 1", "method_version": 1}
    models = {"ded-ko": "koopman@1"}
    lost = False
    for name in (*split.test, *split.train):
        instance, _ = Instance.load_file(problems / "instances" / f"{name}.json", ninebus)
        for regime in ("NO", "TO"):
            for method, lag in METHODS.items():
                part = "test" if name in split.test else "train"
                key = {"instance": name, "split": part, "regime": regime, "method": method}
                own = {"fingerprint": f"{name}{method}"[-12:], "model": models.get(method, "")}
                row = Row(**key, settings="default", status="Optimal", solve_s=lag, **facts | own)
                if method == "ded-ko" and part == "test" and not lost:
                    lost = True
                    failed = dataclasses.replace(row, status="TimeLimit", error="time limit")
                    results.keep(failed, None, ninebus)
                    continue
                schedule = dispatch(ninebus, instance, lag)
                verdict = score(ninebus, instance, schedule, regime)
                results.keep(scored_row(row, verdict), schedule, ninebus)
    timed = TimingRow("run", 1, "TO", "ded", "default", "9bus-0000", "Optimal", solve_s=3.5, host="h")
    timed = dataclasses.replace(timed, case="9bus", problems_version=version, load_average=0.9)
    results.pack()
    other = {"case": "other", "solve_s": 99.0}
    stale = {"method": "ded-ko", "model": models["ded-ko"], "method_version": 2, "solve_s": 9.0}
    TIMING.write(results.paths.timing, [timed, *(dataclasses.replace(timed, **d) for d in (other, stale))])
    return results.folder


@pytest.fixture(scope="module")
def report(problems: Path, finished: Path) -> list[Path]:
    (finished / "policies").mkdir()
    write_arrays(
        finished / "policies" / "ded-dpc-TO.safetensors",
        {"w": np.zeros(2)},
        {"method": "ded-dpc", "training": {"seconds": 123.5, "epochs": 7, "seed": 42, "model": "koopman"}},
    )
    return write_report(Case.load(problems), finished)


def copy(finished: Path, tmp_path: Path) -> Path:
    ignored = shutil.ignore_patterns("figures", "tables")
    return Path(shutil.copytree(finished, tmp_path / "copy", ignore=ignored))


def test_times_of_another_model_or_policy_are_told(problems: Path, finished: Path, tmp_path: Path) -> None:
    folder = copy(finished, tmp_path)
    made = Results(folder).frame()
    model = made[made["method"] == "ded-ko"]["model"].iloc[0]
    timed = dataclasses.replace(TIMING.existing(folder / "timing.csv")[0], method="ded-ko", solve_s=1.0)
    other = model.partition("@")[0] + "@0"
    for timed_model, is_told in ((model, False), (other, True)):
        TIMING.write(folder / "timing.csv", [dataclasses.replace(timed, model=timed_model)])
        write_report(Case.load(problems), folder)
        text = (folder / "report.md").read_text()
        assert (f"Times of DED-KO TO are of {other}, its rows are not." in text) == is_told


def cells(markdown: str, heading: str) -> list[list[str]]:
    """Rows of the first table after a heading."""
    after = markdown[markdown.index(heading) :]
    lines = re.search(r"((?:^\|.*\n)+)", after, re.MULTILINE)
    assert lines
    rows = [line.strip().strip("|").split(" | ") for line in lines.group(1).splitlines()]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_every_file_is_written(report: list[Path], finished: Path) -> None:
    assert all(path.is_file() and path.stat().st_size for path in report)
    names = {str(path.relative_to(finished)) for path in report}
    tables = ("table_v", "table_vi", "summary", "training")
    assert {f"tables/{name}.csv" for name in tables} <= names
    figures = ("schedule_NO", "schedule_TO", "frequencies_TO", "tradeoff")
    assert {f"figures/{name}.png" for name in figures} <= names
    assert {"report.md", "report.html"} <= names


@pytest.mark.parametrize(("name", "columns"), [("table_v", TABLE_V), ("table_vi", TABLE_VI)])
def test_printed_numbers_are_the_csvs(report, finished: Path, name: str, columns) -> None:
    """Cell by cell: page and report round the same numbers as the CSV holds."""
    table = pd.read_csv(finished / "tables" / f"{name}.csv", keep_default_na=False, na_values=[""])
    text = (finished / "report.md").read_text()
    printed = cells(text, {"table_v": "**Table V:", "table_vi": "**Table VI:"}[name])
    assert len(table) == 8
    table = table[table["n"] > 0]  # what was not run is folded away
    assert len(printed) == len(table) == 6
    for row, (_, numbers) in zip(printed, table.iterrows(), strict=True):
        for cell, column in zip(row, columns, strict=True):
            value = numbers[column.name]
            if isinstance(value, float) and math.isnan(value):
                assert cell in ("–", "")
            elif isinstance(value, (int, float, np.number)):
                assert float(cell) == pytest.approx(float(value), rel=5e-3, abs=0)
            else:
                assert cell == value
    page = Page((finished / "report.html").read_text())
    for row in printed:
        assert "".join(row) in page.text.replace("\n", "")


def test_table_v_is_what_the_rows_say(report, finished: Path) -> None:
    """The mean gap over the test instances, computed here again from results.csv."""
    rows = pd.read_csv(finished / "results.csv").query("split == 'test'")
    wide = rows.pivot_table(index=["regime", "instance"], columns="method", values="objective")
    gap = 100 * (wide.div(wide["ded"], axis=0) - 1)
    made = pd.read_csv(finished / "tables" / "table_v.csv").set_index(["regime", "method"])
    for regime in ("NO", "TO"):
        for method in ("ded-ko", "ded-dpc-paper"):
            expected = gap.loc[regime, method].dropna()
            row = made.loc[(regime, method)]
            assert row["increase_percent"] == pytest.approx(expected.mean(), rel=1e-12)
            assert row["n"] == len(expected)
    assert made.loc[("NO", "ded-ko"), ["n", "failures", "model"]].to_list() == [TEST - 1, 1, "koopman"]
    assert made.loc[("TO", "ded"), "solve_s"] == 3.5  # of this case, not of the other one
    assert np.isnan(made.loc[("NO", "ded"), "solve_s"])
    assert np.isnan(made.loc[("TO", "ded-ko"), "solve_s"])  # of another version's answers
    assert made.loc[("NO", "ded-dpc"), "n"] == 0  # not run
    assert made["paper_solve_s"].notna().all()


def test_the_page_needs_nothing_else(report, finished: Path) -> None:
    text = (finished / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not page.open
    assert len(text) < 5 * 2**20
    assert not {"script", "iframe", "object", "embed", "base", "form"} & {t for t, _ in page.tags}
    assert "url(" not in text
    assert "@import" not in text
    anchors = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    assert {str(attributes["href"]) for attributes in page.every("a")} <= {f"#{name}" for name in anchors}
    pictures = [str(attributes["src"]) for attributes in page.every("img")]
    in_markdown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (finished / "report.md").read_text())
    assert len(pictures) == len(in_markdown) >= 4
    for source, path in zip(pictures, in_markdown, strict=True):
        head, data = source.split(",", 1)
        assert head == "data:image/png;base64"
        assert base64.b64decode(data, validate=True) == (finished / path).read_bytes()
    assert all(attributes.get("alt") for attributes in page.every("img"))


def test_the_report_says_what_made_the_numbers(report, finished: Path) -> None:
    text = (finished / "report.md").read_text()
    assert cells(text, "## Training")[0][:3] == ["ded-dpc-TO", "124", "7"]
    assert "- Surrogates and policies: koopman@1.\n" in text


def test_the_instance_shown_is_usual(problems: Path, finished: Path) -> None:
    """Of five instances one of the two with gaps nearest to the median; the reference comes first."""
    sources = read_sources(Case.load(problems), finished)
    rows = sources.judged[(sources.judged["regime"] == "TO") & (sources.judged["method"] == "ded-dpc-paper")]
    gap = rows.set_index("instance")["gap_percent"]
    nearest = (gap - gap.median()).abs().sort_values().index.to_list()
    chosen = representative(sources, "TO")
    assert chosen["method"].to_list() == ["ded", "ded-dpc-paper"]
    assert set(chosen["instance"]) < set(nearest[:2])


@pytest.mark.usefixtures("sketched")
def test_broken_pieces_are_named_and_left_out(problems: Path, finished: Path, tmp_path) -> None:
    folder = copy(finished, tmp_path)
    results = Results(folder)
    archive = results.paths.archive("ded-dpc-paper", "default", "TO")
    archive.write_bytes(b"no archive")
    (folder / "policies").mkdir(exist_ok=True)
    (folder / "policies" / "bad.safetensors").write_bytes(b"\xffrubbish")
    write_report(Case.load(problems), folder)
    text = (folder / "report.md").read_text()
    assert "policies/bad.safetensors" in text
    assert archive.name in text


@pytest.mark.usefixtures("sketched")
def test_strangers_text_stays_text(ninebus: Case, problems: Path, finished: Path, tmp_path: Path) -> None:
    """A method's name or error can hold anything; the page shows it and runs none of it."""
    folder = copy(finished, tmp_path)
    results = Results(folder)
    row = next(iter(results.rows.values()))
    evil, name = "<script>alert(1)</script>|`x`", "<img src=x onerror=alert(1)>$x{$"
    strange = dataclasses.replace(row, method=name, settings="a|b", error=evil, solver_version=evil)
    instance, _ = Instance.load_file(problems / "instances" / f"{row.instance}.json", ninebus)
    results.keep(strange, results.schedule(row, ninebus, instance), ninebus)
    results.add([dataclasses.replace(strange, regime="XX")])
    write_report(Case.load(problems), folder)
    page = Page((folder / "report.html").read_text())
    assert "script" not in {tag for tag, _ in page.tags}
    assert all(str(attributes["src"]).startswith("data:") for attributes in page.every("img"))
    assert name in page.text
    five = cells((folder / "report.md").read_text(), "**Table V:")
    assert all(len(line) == len(TABLE_V) for line in five[:2])
