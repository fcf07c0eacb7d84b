"""The report's part on the closed loop: its tables and figures from a short operation."""

from __future__ import annotations

import dataclasses

import pandas as pd
import pytest

from ded_bench.methods import ed
from ded_bench.problem.sampling import sample_scenario
from ded_bench.report.overview import write_overview
from ded_bench.report.report import write_report
from ded_bench.results.online_results import OnlineResults, OnlineRow, keep_trajectory
from ded_bench.results.rows import Results, Row
from ded_bench.run.online.judgement import judge_operation
from ded_bench.run.online.loop import LoopOptions, run_loop
from ded_bench.run.online.planner import Planned

STATIC = {"scenario": "s", "regime": "TO", "method": "ed", "settings": "every=1", "period_s": 1.0}
STATIC |= {"forecast": "announced", "predicted": True, "warm": True}


@pytest.fixture(scope="module")
def folder(threebus, tmp_path_factory):
    """One scenario of the chain under static dispatch at its own latency, and at one that was asked for."""
    results = OnlineResults(tmp_path_factory.mktemp("online"))
    scenario = sample_scenario(threebus, 0, 0, None, threebus.sampling.horizon_s)
    for latency in (0.0, 0.5):
        options = LoopOptions(latency_s=latency)
        trajectory = run_loop(
            threebus, scenario, lambda i, _: Planned(ed.dispatch(threebus, i, 1.0)), options
        ).trajectory
        row = OnlineRow(
            **STATIC | {"scenario": scenario.id, "latency_s": latency},
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
    assert "## The closed loop" in (folder / "report.md").read_text()
    own = pd.read_csv(folder / "tables" / "online_methods.csv")
    assert own["increase_percent_mean"].tolist() == pytest.approx([1.0])
    assert own["title"].tolist() == ["ED [every=1]"]
    names = {path.name for path in (folder / "figures").iterdir()}
    assert "online_scenario.png" in names
    Results(tmp_path / "other").add([Row("x", "test", "TO", "ed", "default", "Feasible", objective=1.0)])
    write_report(threebus, tmp_path / "other", tmp_path / "no-problems")
    assert "The closed loop" not in (tmp_path / "other" / "report.md").read_text()


def test_the_overview_sets_grids_side_by_side(tmp_path):
    """Only grids that were operated have lines."""
    for case in ("9bus", "two-area"):
        row = Row("x", "test", "TO", "ed", "default", "Feasible", objective=1.0, case=case)
        Results(tmp_path / case).add([row])
    known = {"objective": 1.0, "increase_percent": 0.25, "latency_source": "timing", "case": "two-area"}
    OnlineResults(tmp_path / "two-area").table.add([OnlineRow(**STATIC, latency_s=0.5, **known)])
    write_overview([tmp_path / case for case in ("9bus", "two-area")], tmp_path / "out")
    lines = pd.read_csv(tmp_path / "out" / "tables" / "online.csv")
    assert lines[["case", "title", "increase_percent_mean"]].to_numpy().tolist() == [
        ["two-area", "ED [every=1]", 0.25]
    ]
