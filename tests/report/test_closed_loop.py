"""The report's part on the closed loop: its tables and figures from a short operation."""

from __future__ import annotations

import dataclasses

import pandas as pd
import pytest

from ded_bench.analysis.online_summary import practice_rows
from ded_bench.methods import ed
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import sample_scenario
from ded_bench.report.overview import write_overview
from ded_bench.report.report import write_report
from ded_bench.results.online_results import OnlineResults, OnlineRow, keep_trajectory
from ded_bench.results.rows import Results, Row
from ded_bench.run.online.judgement import judge_operation
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from tests.detailed_cases import MIXED

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
    return results.files.path


@pytest.mark.usefixtures("sketched")
def test_the_report_has_a_part_of_its_own(threebus, folder, tmp_path):
    """Tables in files, too; nothing about the loop without its rows."""
    write_report(threebus, folder)
    assert "## The closed loop" in (folder / "report.md").read_text()
    own = pd.read_csv(folder / "tables" / "online_methods.csv")
    assert own["increase_percent_mean"].tolist() == pytest.approx([1.0])
    assert own["title"].tolist() == ["ED [every=1]"]
    names = {path.name for path in (folder / "figures").iterdir()}
    assert "online_scenario.png" in names
    Results(tmp_path / "other").add([Row("x", "test", "TO", "ed", "default", "Feasible", objective=1.0)])
    write_report(threebus, tmp_path / "other")
    assert "The closed loop" not in (tmp_path / "other" / "report.md").read_text()


@pytest.mark.usefixtures("sketched")
def test_an_island_s_report_sets_plans_beside_practice(tmp_path):
    """Ratios and cost over ED every 60 s in the same scenario; a run that failed counts; a picture."""
    case, results = Case.load(MIXED), OnlineResults(tmp_path / "island")
    scenario = sample_scenario(case, 0, 0, servable, 120.0)
    for every in (60.0, 1.0):
        options = LoopOptions(period_s=every)
        ask = lambda i, _, every=every: Planned(ed.dispatch(case, i, every))  # noqa: E731
        trajectory = run_loop(case, scenario, ask, options).trajectory
        known = STATIC | {"scenario": scenario.id, "settings": f"every={every:g}", "period_s": every}
        known |= {"latency_s": 0.0, "plant": "detailed", "case": case.id, "plans": round(120 / every)}
        row = OnlineRow(**known, **dataclasses.asdict(judge_operation(case, scenario, trajectory, "TO")))
        keep_trajectory(results.files.trajectory(row.key), trajectory)
        failed = OnlineRow(**known | {"scenario": "lost", "plans": 0}, error="the system cannot follow")
        results.table.add([row, failed])
    write_report(case, results.files.path)
    practice, static = pd.read_csv(tmp_path / "island" / "tables" / "practice.csv").to_dict("records")
    rows = {row.settings: row for row in results.table.rows.values() if not row.error}
    assert (practice["n"], practice["failures"], practice["minutes"]) == (1, 1, 2)
    assert (practice["peak_ratio"], practice["over_practice_percent"]) == (1.0, 0.0)
    one, other = rows["every=60"], rows["every=1"]
    assert static["peak_ratio"] == pytest.approx(one.mean_freq_max_hz / other.mean_freq_max_hz)
    assert static["travel_ratio"] == pytest.approx(one.agc_travel_pu / other.agc_travel_pu)
    assert static["over_practice_percent"] == pytest.approx(100 * (other.objective / one.objective - 1))
    assert static["mean_peak_mhz"] == pytest.approx(1e3 * other.mean_freq_max_hz)
    assert (tmp_path / "island" / "figures" / "online_scenario.png").is_file()


def test_a_scenario_that_nobody_brought_to_its_end_lasts_as_long_as_its_like(tmp_path):
    results, known = OnlineResults(tmp_path), STATIC | {"period_s": 60.0, "latency_s": 0.0, "case": "g"}
    for name, plans in (("g-s0000", 5), ("g-h0000", 60), ("g-h0001", 0), ("other", 0)):
        score = {"objective": 1.0, "cps1": 100.0} if plans else {"error": "the system cannot follow"}
        results.table.add([OnlineRow(**known | {"scenario": name, "plans": plans} | score)])
    frame = practice_rows(results, "g").set_index("scenario")
    assert frame["minutes"].to_dict() == {"g-s0000": 5, "g-h0000": 60, "g-h0001": 60, "other": 5}


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
