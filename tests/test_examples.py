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
from ded_bench.plants.lossless.servable import servable

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
    """More iterations cost less; tables of what is trained have a row for each, which differ after a step."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import unrolled_choices

    values = {
        "iterations": (5, 80),
        "learned-iterations": (2, 8),
        "price": (0.1, 0.2),
        "hopeless": (0.01, 0.1),
    }
    monkeypatch.setattr(unrolled_choices, "VALUES", values)
    monkeypatch.setattr(unrolled_choices.unrolled_training, "STEPS", 1)
    for choice in values:
        unrolled_choices.main([choice, "--case", "two-area", "--draws", "2", "--out", str(tmp_path)])
    by_iterations = pd.read_csv(tmp_path / "iterations-two-area-TO.csv")
    assert by_iterations["gap_percent"].is_monotonic_decreasing
    assert (by_iterations["n"] == 2).all()
    monkeypatch.setitem(unrolled_choices.VALUES, "learned-for", (1, 10))
    unrolled_choices.main(["learned-for", "--regime", "NO", "--draws", "2", "--out", str(tmp_path)])
    assert pd.read_csv(tmp_path / "learned-for-39bus-NO.csv")["gap_percent"].nunique() == 2
    for choice in ("learned-iterations", "price", "hopeless"):
        table = pd.read_csv(tmp_path / f"{choice}-two-area-TO.csv").set_index(choice)
        assert table.index.tolist() == list(values[choice])
        assert table["gap_percent"].nunique() == 2


def test_one_policy_for_several_grids(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A step of training on two grids; its weights answer on each, and on one that they have not seen."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import one_policy

    monkeypatch.setattr(one_policy, "TRAINED", ("9bus", "two-area"))
    monkeypatch.setattr(one_policy, "DRAWS", {"two-area": 2, "39bus": 2})
    one_policy.main(["--steps", "1", "--regime", "NO", "--out", str(tmp_path)])
    assert np.abs(one_policy.read_start(tmp_path / "weights-NO.safetensors")["nodes"]).max() > 1e-4
    table = pd.read_csv(tmp_path / "table-NO.csv").set_index(["grid", "weights"])
    assert (table["feasible"] == 2).all()
    assert (table["gap_percent"] < 3.0).all()  # where training starts it is 1 % on 39bus
    for grid in ("two-area", "39bus"):
        assert table.loc[(grid, "its own"), "gap_percent"] <= table.loc[(grid, "of all"), "gap_percent"]


def test_better_announcements(ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notice tells the ramps as they are; a wait puts off what has not begun, and nothing else."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from better_announcements import Announcements, forecast

    scenario = sample_scenario(ninebus, 4242, 0)
    load, number = scenario.load[ninebus.loads[0]], 0
    ramp = next(r for r in load.ramps if r.announced_start is not None and r.start > 5.0)
    now, after = ramp.start - 1.0, ramp.start + np.array([0.0, 0.2])

    def slope(announcements: Announcements) -> float:
        told = announcements(scenario, ninebus, "announced", now, now + 60.0).at(after)[:, number]
        return float(np.diff(told)[0]) / 0.2

    assert slope(Announcements(2.0, 0.0)) == pytest.approx(ramp.rate, abs=5e-4)  # fluctuations decay slowly
    assert slope(Announcements(0.0, 30.0)) == pytest.approx(0.0, abs=5e-4)
    given = (scenario, ninebus, "announced", now, now + 60.0)
    times = np.linspace(now, now + 60.0, 50)
    assert np.array_equal(Announcements(0.0, 0.0)(*given).at(times), forecast(*given).at(times))
