"""The examples run, and do what they say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ded_bench
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.scenario_sampling import sample_scenario
from ded_bench.truth.servable import servable

EXAMPLES = REPOSITORY / "examples"


def test_the_tour(tmp_path: Path) -> None:
    """Static dispatch breaks the tight bound, the other methods keep it, and a figure shows it."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, EXAMPLES / "tour.py"]
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    table = pd.read_csv(tmp_path / "results" / "tour" / "table.csv")
    feasible = table.groupby("method")["feasible"].all()
    assert feasible.to_dict() == {"ed": False, "ded-dpc": True, "ded-ko-knots": True, "ded-slp": True}
    assert (tmp_path / "results" / "tour" / "schedules.png").stat().st_size > 10_000


def test_dispatch_with_foresight(ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps bounds, ramps and P_0, and costs no more than static dispatch would without them."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import lookahead_dispatch

    instance = sample_instance(ninebus, 1_500_000, 0)
    schedule = lookahead_dispatch.solve(instance, "NO", ninebus)
    verdict = ded_bench.score(instance, schedule, "NO")
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) < 1e-8


def test_a_line_outage(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without more training the policy keeps the bound on its own grid, and refined on the other, too."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import line_outage

    line_outage.main(["--epochs", "0", "--draws", "2", "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "table.csv").set_index(["weights", "grid"])
    assert (table["n"] == 2).all()
    assert table.loc[("reference", "two-area"), "feasible"] == 2
    refined = table.loc[[("reference, refined", "two-area"), ("reference, refined", "two-area-outage")]]
    assert (refined["feasible"] == 2).all()
    assert (refined["gap_percent"] < 1.0).all()


def test_no_first_plan(ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Powers stay as long as no plan is in force; then the solver is asked."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import no_first_plan

    instance = sample_instance(ninebus, 1_500_000, 0)
    solver = no_first_plan.prepare(ninebus, "TO", None)
    first = solver.solve(instance)
    assert (first.p == instance.p_initial(ninebus)).all()
    planned = solver.solve(instance, ded_bench.Solution(ded_bench.Status.FEASIBLE, first)).schedule
    verdicts = [ded_bench.score(instance, schedule, "TO") for schedule in (first, planned)]
    assert verdicts[1].objective < verdicts[0].objective
    assert verdicts[1].feasible


def test_stretches_around_ramps_that_nobody_announces(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loads are those of the scenario from 20 s before the ramp; other scenarios have none."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import unannounced_ramps

    case = Case.load("two-area")
    scenarios = [sample_scenario(case, 77, index, servable) for index in (5, 6)]
    (data,) = unannounced_ramps.stretches(case, scenarios)
    stretch = Scenario.model_validate_json(json.dumps(data))
    stretch.check_case(case)
    (ramp,) = (ramp for ramp in scenarios[1].load["7"].ramps if ramp.rate == 0.093139983)
    (same,) = (one for one in stretch.load["7"].ramps if one.rate == ramp.rate)
    assert (same.start, same.announced_start) == (pytest.approx(20.0), None)
    # The fluctuation is linear between other points; its standard deviation is 5e-4 of the load.
    then = scenarios[1].p_load(case, ramp.start - 20.0 + stretch.grid)
    assert np.allclose(stretch.p_load(case), then, atol=2e-3)


def test_choices_of_the_unrolled_policy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """More iterations cost less; the table by price has a row for each, trained by a step."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import unrolled_choices

    monkeypatch.setattr(unrolled_choices, "ITERATIONS", (5, 80))
    monkeypatch.setattr(unrolled_choices, "PRICES", (0.1, 0.2))
    monkeypatch.setattr(unrolled_choices.unrolled_training, "STEPS", 1)
    for choice in ("iterations", "price"):
        unrolled_choices.main([choice, "--case", "two-area", "--draws", "2", "--out", str(tmp_path)])
    by_iterations = pd.read_csv(tmp_path / "iterations-two-area.csv")
    assert by_iterations["gap_percent"].is_monotonic_decreasing
    assert (by_iterations["n"] == 2).all()
    assert pd.read_csv(tmp_path / "price-two-area.csv")["price"].tolist() == [0.1, 0.2]
