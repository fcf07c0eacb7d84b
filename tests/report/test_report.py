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

from ded_bench.analysis.summary import title
from ded_bench.results.timing import TIMING, TimingRow
from ded_bench.files.arrays import write_arrays
from ded_bench.surrogates.linear import linear_model
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.benchmark import load_split
from ded_bench.problem.schedule import Schedule
from ded_bench.report.columns import GAPS, TABLE_V, TABLE_VI
from ded_bench.report.figures.plan import plan
from ded_bench.report.report import write_report
from ded_bench.run.pool import Workers
from ded_bench.results.rows import Key, Results, Row
from ded_bench.run.scoring import scored_row
from ded_bench.plants.score import score
from tests.evaluate.test_summary import DED, with_gaps
from tests.reading import Page
from tests.report.conftest import TEST, TRAIN


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
    folder = tmp_path_factory.mktemp("results")
    results = Results(folder)
    split = load_split(problems)
    version = json.loads((problems / "MANIFEST.json").read_text())["version"]
    rows, schedules, instances = [], [], []
    for name in (*split.test, *split.train):
        instance, _ = Instance.load_file(problems / "instances" / f"{name}.json", ninebus)
        for regime in ("NO", "TO"):
            for method, lag in (("ded", 0.05), ("ded-ko", 1.0), ("ded-dpc-paper", 5.0)):
                part = "test" if name in split.test else "train"
                status = "Policy" if "dpc" in method else "Optimal"
                facts = {
                    "problems_version": version,
                    "version": "1",
                    "host": "h",
                    "date": "2026-01-01T00:00:00Z",
                }
                rows.append(
                    Row(
                        name,
                        part,
                        regime,
                        method,
                        "default",
                        status,
                        solve_s=lag,
                        case="9bus",
                        seed="3 1",
                        **facts,
                    )
                )
                schedules.append(dispatch(ninebus, instance, lag))
                instances.append(instance)
    scores = [score(ninebus, *run, row.regime) for *run, row in zip(instances, schedules, rows, strict=True)]
    for row, schedule in zip(rows, schedules, strict=True):
        schedule.write(results.schedule_path(row.key), ninebus.generators)
    rows = [scored_row(row, verdict) for row, verdict in zip(rows, scores, strict=True)]
    lost = next(i for i, row in enumerate(rows) if row.method == "ded-ko" and row.split == "test")
    empty = dict.fromkeys(("objective", "feasible", "feasible_strict", "freq_violation_hz", "ramp_violation"))
    rows[lost] = dataclasses.replace(rows[lost], status="TimeLimit", error="time limit", **empty)
    results.schedule_path(rows[lost].key).unlink()
    results.add(rows)
    timed = TimingRow("run", 1, "TO", "ded", "default", "9bus-0000", "Optimal", solve_s=3.5, host="h")
    timed = dataclasses.replace(timed, case="9bus", problems_version=version, load_average=0.9)
    TIMING.write(folder / "timing.csv", [timed, dataclasses.replace(timed, case="other", solve_s=99.0)])
    return folder


@pytest.fixture(scope="module")
def report(ninebus: Case, problems: Path, finished: Path) -> list[Path]:
    linear_model(ninebus).save(finished / "koopman" / "linear-copy.safetensors")
    history = pd.DataFrame(
        {"epoch": [1, 2], "seconds": [1.0, 2.0], "training": [3.0, 2.0], "held out": [3.0, 2.5]}
    )
    (finished / "policies").mkdir()
    history.assign(objective=[2.0, 1.0]).to_csv(finished / "policies" / "ded-dpc-TO.history.csv", index=False)
    write_arrays(
        finished / "policies" / "ded-dpc-TO.safetensors",
        {"w": np.zeros(2)},
        {"method": "ded-dpc", "training": {"seconds": 123.5, "epochs": 7, "seed": 42, "model": "koopman"}},
    )
    with Workers(2) as pool:
        return write_report(ninebus, finished, problems, pool)


def copy(finished: Path, tmp_path: Path) -> Path:
    return Path(
        shutil.copytree(finished, tmp_path / "copy", ignore=shutil.ignore_patterns("figures", "tables"))
    )


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
    assert {f"tables/table_{n}.{form}" for n in ("v", "vi") for form in ("csv", "md", "tex")} <= names
    figures = (
        "schedule_NO",
        "schedule_TO",
        "frequencies_TO",
        "koopman_TO",
        "tradeoff",
        "profile",
        "training_ded-dpc",
    )
    figures += ("parameters", "forecasts", "koopman_error", "koopman_eigenvalues")
    assert {f"figures/{name}.{form}" for name in figures for form in ("png", "pdf")} <= names
    assert {"report.md", "report.html"} <= names


@pytest.mark.parametrize(("name", "columns"), [("table_v", TABLE_V), ("table_vi", TABLE_VI)])
def test_printed_numbers_are_the_csvs(report, finished: Path, name: str, columns) -> None:
    """Cell by cell: Markdown, page and report round the same numbers as the CSV holds."""
    table = pd.read_csv(finished / "tables" / f"{name}.csv", keep_default_na=False, na_values=[""])
    for text in ((finished / "tables" / f"{name}.md").read_text(), (finished / "report.md").read_text()):
        heading = (
            "| Regime" if text.startswith("|") else {"table_v": "**Table V:", "table_vi": "**Table VI:"}[name]
        )
        printed = cells(text, heading)
        assert len(printed) == len(table) == 8
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
    for row in cells((finished / "tables" / f"{name}.md").read_text(), "| Regime"):
        assert "".join(row) in page.text.replace("\n", "")


def test_the_papers_numbers_are_printed_as_the_paper_does(report, finished: Path) -> None:
    for name, numbers in (("v", ("32.34", "0.094", "17.34", "1.05", "5.2")), ("vi", ("1.84e-09", "0.0013"))):
        text = (finished / "tables" / f"table_{name}.md").read_text()
        assert all(f"| {number} |" in text for number in numbers)
    latex = (finished / "tables" / "table_vi.tex").read_text()
    assert "$1.84 \\times 10^{-9}$" in latex
    assert "\\caption{Average maximum constraint violation (5 test instances" in latex


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
    assert made.loc[("NO", "ded-ko"), ["n", "failures"]].to_list() == [TEST - 1, 1]
    assert made.loc[("TO", "ded"), "solve_s"] == 3.5  # of this case, not of the other one
    assert np.isnan(made.loc[("NO", "ded"), "solve_s"])
    assert made["paper_solve_s"].notna().all()


def test_training_rows_are_left_out_and_counted(report, finished: Path) -> None:
    text = (finished / "report.md").read_text()
    assert f"{TEST} test instances; {2 * 3 * TRAIN} other rows left out" in text
    everything = cells(text, "<summary>Methods that were run on training instances too")
    assert [row[2] for row in everything] == [str(TEST + TRAIN)] * 6
    detail = cells(text, "**Gap to DED, % (")
    assert [row[2] for row in detail] == [str(TEST)] * 6
    assert len(detail[0]) == len(GAPS)


def test_the_page_needs_nothing_else(report, finished: Path) -> None:
    text = (finished / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not page.open
    assert len(text) < 10 * 2**20
    assert not {"script", "iframe", "object", "embed", "video", "audio", "base", "form"} & {
        t for t, _ in page.tags
    }
    assert "url(" not in text
    assert "@import" not in text
    anchors = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    for attributes in page.every("a"):
        assert str(attributes["href"])[1:] in anchors
        assert str(attributes["href"])[0] == "#"
    assert [attributes["href"] for attributes in page.every("link")] == ["data:,"]
    pictures = [str(attributes["src"]) for attributes in page.every("img")]
    in_markdown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (finished / "report.md").read_text())
    assert len(pictures) == len(in_markdown) > 10
    for source, path in zip(pictures, in_markdown, strict=True):
        head, data = source.split(",", 1)
        assert head == "data:image/png;base64"
        assert base64.b64decode(data, validate=True) == (finished / path).read_bytes()
    assert all(attributes.get("alt") for attributes in page.every("img"))


def test_the_report_says_what_made_the_numbers(report, finished: Path) -> None:
    text = (finished / "report.md").read_text()
    for fact in (
        "Hosts of the rows: h",
        "Master seeds of the instances: 3",
        "python 3",
        "casadi",
        "Problem version: 1-",
    ):
        assert fact in text
    assert "| ded-dpc-TO | 123.5 | 7 |" in text.replace("124", "123.5")
    assert "## What made the rows" in text
    assert f"{6 * TEST - 1} rows do not say which code made them: " in text
    assert f"Only {TEST - 1} of" not in text
    assert "Times of other cases are left out: 1 methods" in text
    assert "No certificate" in text


@pytest.mark.usefixtures("sketched")
def test_the_second_report_has_the_same_tables(
    report, ninebus: Case, problems: Path, finished, tmp_path
) -> None:
    again = copy(finished, tmp_path)
    write_report(ninebus, again, problems)
    for path in sorted((finished / "tables").iterdir()):
        assert (again / "tables" / path.name).read_bytes() == path.read_bytes()


def test_the_instance_shown_is_usual_and_its_loads_move(finished: Path) -> None:
    """Of five instances the two with gaps nearest to the median take part."""
    frame = with_gaps(Results(finished).frame().query("split == 'test'"))
    wide = frame[frame["regime"] == "TO"].pivot_table(index="instance", columns="method", values="objective")
    gap = 100 * wide["ded-dpc-paper"] / wide["ded"]
    nearest = (gap - gap.median()).abs().sort_values().index.to_list()
    for wanted in nearest[:2]:
        moves = dict.fromkeys(gap.index, 0.0) | {wanted: 1.0, nearest[2]: 9.0}
        chosen = plan(frame, DED, lambda key: True, moves.__getitem__).representative["TO"]
        assert [key.method for key in chosen] == ["ded", "ded-dpc-paper"]
        assert {key.instance for key in chosen} == {wanted}
    without = plan(frame, DED, lambda key: key.instance != nearest[0], lambda name: 0.0).representative["TO"]
    assert without[0].instance in nearest[1:3]


@pytest.mark.usefixtures("sketched")
def test_broken_pieces_are_named_and_left_out(
    ninebus: Case, problems: Path, finished: Path, tmp_path
) -> None:
    folder = copy(finished, tmp_path)
    results = Results(folder)
    rows = with_gaps(results.frame().query("split == 'test'"))
    broken = results.schedule_path(plan(rows, DED, lambda key: True, len).representative["TO"][1])
    broken.write_bytes(b"no gzip")
    (folder / "koopman").mkdir(exist_ok=True)
    (folder / "policies").mkdir(exist_ok=True)
    for name in ("koopman/bad.safetensors", "policies/bad.safetensors"):
        (folder / name).write_bytes(b"\xffrubbish")
    write_report(ninebus, folder, problems)
    text = (folder / "report.md").read_text()
    for name in ("koopman/bad.safetensors", "policies/bad.safetensors", broken.name):
        assert name in text


@pytest.mark.usefixtures("sketched")
def test_strangers_text_stays_text(ninebus: Case, problems: Path, finished: Path, tmp_path: Path) -> None:
    """A method's name or error can hold anything; the page shows it and runs none of it."""
    folder = copy(finished, tmp_path)
    results = Results(folder)
    row = next(iter(results.rows.values()))
    evil = "<script>alert(1)</script>|`x`"
    name = "<img src=x onerror=alert(1)>"
    strange = dataclasses.replace(row, method=name, settings="a|b", error=evil, solver_version=evil)
    results.add([strange, dataclasses.replace(strange, regime="XX")])
    shutil.copytree(folder / "schedules" / row.method, folder / "schedules" / name)
    (folder / "schedules" / name / "default").rename(folder / "schedules" / name / "a|b")
    write_report(ninebus, folder, problems)
    page = Page((folder / "report.html").read_text())
    assert "script" not in {tag for tag, _ in page.tags}
    assert all(str(attributes["src"]).startswith("data:") for attributes in page.every("img"))
    assert name in page.text
    assert all(
        len(line) == len(TABLE_V) for line in cells((folder / "report.md").read_text(), "**Table V:")[:2]
    )


@pytest.mark.usefixtures("sketched")
def test_what_cannot_be_compared_is_said(
    ninebus: Case, problems: Path, finished: Path, tmp_path: Path
) -> None:
    folder = copy(finished, tmp_path)
    results = Results(folder)
    row = next(iter(results.rows.values()))
    unscored = dict.fromkeys(("objective", "feasible", "feasible_strict"))
    results.add([dataclasses.replace(row, problems_version="0-old", version="0", **unscored)])
    slow = (folder / "timing.csv").read_text().replace(",0.9,", ",3.0,")
    (folder / "timing.csv").write_text(slow)
    write_report(ninebus, folder, problems)
    text = (folder / "report.md").read_text()
    assert "Rows of different problem versions are not comparable: 0-old, 1-" in text
    assert "Rows of several versions of ded-bench: 0, 1" in text
    assert "1 rows have a schedule but no score yet" in text
    assert "while the machine was busy" in text


@pytest.mark.usefixtures("sketched")
def test_a_row_whose_instance_is_unknown_is_tabulated_but_not_drawn(
    ninebus, problems, finished, tmp_path
) -> None:
    folder = copy(finished, tmp_path)
    row = next(row for row in Results(folder).rows.values() if row.method == "ded")
    (folder / "results.csv").unlink()
    Results(folder).add([dataclasses.replace(row, instance="stranger")])
    write_report(ninebus, folder, problems)
    assert not list((folder / "figures").glob("schedule_*"))
    assert len(pd.read_csv(folder / "tables" / "summary.csv")) == 1
    text = (folder / "report.md").read_text()
    assert "no trajectory is drawn" in text
    assert f"Only 0 of {TEST} test instances were run: {title('ded')} {row.regime} (without 9bus-" in text
    other = next(regime for regime in ninebus.regimes if regime != row.regime)
    assert f"No rows of {title('ded')} in regime {other}." in text


def test_only_runs_that_can_be_drawn_are_among_the_worst(finished: Path) -> None:
    frame = with_gaps(Results(finished).frame())
    kept = frame["instance"].iloc[0]
    chosen = plan(frame, DED, lambda key: key.instance == kept, len)
    assert {key.instance for pairs in chosen.worst.values() for key, _ in pairs} == {kept}


def test_keys_of_the_plan_include_ded_for_comparison(finished: Path) -> None:
    chosen = plan(with_gaps(Results(finished).frame()), DED, lambda key: True, len)
    for (regime, method, settings), pairs in chosen.worst.items():
        for key, _ in pairs:
            assert key[1:] == (regime, method, settings)
            assert Key(key.instance, regime, "ded", "default") in chosen.keys
