"""The report's part on the closed loop: its tables and figures from a short operation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from ded_bench.methods import ed
from ded_bench.run.online.judgement import judge_operation
from ded_bench.run.online.loop import LoopOptions, run_loop
from ded_bench.results.online_results import OnlineKey, OnlineResults, OnlineRow, keep_trajectory
from ded_bench.analysis.online_summary import online_rows, operated, own_latency, sweeps
from ded_bench.run.online.planner import Plan
from ded_bench.problem.sampling import sample_scenario
from ded_bench.report.figures.online import forecast_figure, latency_figure
from ded_bench.report.overview import write_overview
from ded_bench.report.report import write_report
from ded_bench.results.rows import Results, Row


@pytest.fixture(scope="module")
def folder(threebus, tmp_path_factory):
    """One scenario of the chain under static dispatch at three latencies, one of them its own."""
    results = OnlineResults(tmp_path_factory.mktemp("online"))
    scenario = sample_scenario(threebus, 0, 0, None, threebus.sampling.horizon_s)
    for latency in (0.0, 0.5, 2.0):
        options = LoopOptions(latency_s=latency)
        trajectory = run_loop(
            threebus, scenario, lambda i, _: Plan(ed.dispatch(threebus, i, 1.0)), options
        ).trajectory
        row = OnlineRow(
            *(scenario.id, "TO", "ed", "1s", 1.0, latency, "announced", True, True),
            **dataclasses.asdict(judge_operation(threebus, scenario, trajectory, "TO")),
            increase_percent=1.0 + latency,
            plans=6,
            latency_source="given" if latency else "timing",
            case=threebus.id,
        )
        keep_trajectory(results.files.trajectory(row.key), trajectory)
        results.table.add([row])
    return results.files.folder


@pytest.mark.usefixtures("sketched")
def test_the_report_has_a_part_of_its_own(threebus, folder, tmp_path):
    """Tables in files, too; nothing about the loop without its rows."""
    write_report(threebus, folder, tmp_path / "no-problems")
    text = (folder / "report.md").read_text()
    assert "## The closed loop" in text
    own = pd.read_csv(folder / "tables" / "online_methods.csv")
    (row,) = (r for r in OnlineResults(folder).table.rows.values() if r.latency_source == "timing")
    assert own["increase_percent_mean"].tolist() == pytest.approx([row.increase_percent])
    assert own["title"].tolist() == ["ED [1s]"]
    assert (folder / "figures" / "online_scenario.png").is_file()
    Results(tmp_path / "other").add([Row("x", "test", "TO", "ed", "1s", "Feasible", objective=1.0)])
    write_report(threebus, tmp_path / "other", tmp_path / "no-problems")
    assert "The closed loop" not in (tmp_path / "other" / "report.md").read_text()


def test_the_overview_sets_grids_side_by_side(tmp_path):
    """Only grids that were operated have lines."""
    row = OnlineRow("s", "TO", "ed", "1s", 1.0, 0.5, "announced", True, True, objective=1.0)
    for case in ("9bus", "two-area"):
        Results(tmp_path / case).add(
            [Row("x", "test", "TO", "ed", "1s", "Feasible", objective=1.0, case=case)]
        )
    known = {"increase_percent": 0.25, "latency_source": "timing", "case": "two-area"}
    OnlineResults(tmp_path / "two-area").table.add([dataclasses.replace(row, **known)])
    write_overview([tmp_path / case for case in ("9bus", "two-area")], tmp_path / "out")
    lines = pd.read_csv(tmp_path / "out" / "tables" / "online.csv")
    assert lines[["case", "title", "increase_percent_mean"]].to_numpy().tolist() == [
        ["two-area", "ED [1s]", 0.25]
    ]


def test_the_loop_on_ac_has_a_table_of_its_own(tmp_path):
    """Means over scenarios of each way of operating; rows on the lossless network stay in theirs."""
    key = OnlineKey("s0", "TO", "ded-slp", "ac", 1.0, 0.3, "announced", True, True, "ac")
    row = OnlineRow(*key, objective=2.0, case="two-area")
    rows = [
        dataclasses.replace(row, max_excess_hz=1e-3),
        dataclasses.replace(row, scenario="s1", max_excess_hz=3e-3),
        dataclasses.replace(row, truth="paper", max_excess_hz=9e-3),
    ]
    OnlineResults(tmp_path).table.add(rows)
    (line,) = operated(online_rows(OnlineResults(tmp_path), "two-area", "ac")).to_dict("records")
    assert (line["n"], line["max_excess_mhz_mean"]) == (2, pytest.approx(2.0))


def test_figures_show_the_numbers(threebus, folder):
    """A method's marker lies at its latency; a forecast starts at what is measured."""
    frame = online_rows(OnlineResults(folder), "threebus")
    figure = latency_figure(sweeps(frame), own_latency(frame), "")
    cost = figure.axes[0]
    swept, own = cost.get_lines()[0], cost.get_lines()[1]
    assert list(swept.get_xdata()) == [0.0, 0.5, 2.0]
    assert own.get_xdata()[0] == 0.0
    assert own.get_ydata()[0] == swept.get_ydata()[0]
    assert swept.get_label() == "forecast as announced"
    assert not any(ax.texts for ax in figure.axes)  # one setting of each method: the legend tells them apart
    other = own_latency(frame).assign(settings="10s", latency_s=0.3)
    figure = latency_figure(sweeps(frame), pd.concat([own_latency(frame), other]), "")
    assert all({word.get_text() for word in ax.texts} == {"1s", "10s"} for ax in figure.axes)
    scenario = sample_scenario(threebus, 0, 0, None, threebus.sampling.horizon_s)
    (ax,) = forecast_figure(threebus, scenario, "").axes
    truth, *seen = (line for line in ax.get_lines() if len(line.get_xdata()) > 1)
    for line in seen:
        came = np.interp(line.get_xdata()[0], truth.get_xdata(), truth.get_ydata())
        assert line.get_ydata()[0] == pytest.approx(came, abs=1e-12)
