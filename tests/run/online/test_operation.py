"""Rows of online.csv: the same every time, resumed, compared with hindsight, and the command's exit codes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil

import numpy as np
import pytest

from ded_bench.cli import main
from ded_bench.cli.online_commands import _print_row
from ded_bench.files.arrays import read_arrays
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import scenario_files, write_scenarios
from ded_bench.problem.scenario import load_scenarios
from ded_bench.results.folder import OnlineKey
from ded_bench.results.online_results import OnlineResults, OnlineRow
from ded_bench.results.timing import TIMING, TimingRow
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from ded_bench.run.online.operation import make_operations, operate
from ded_bench.run.pool import Workers
from tests.conftest import CASE_FILES, answers_here

FAULTY = "tests.run.online.faulty_methods"
#: What the clock and the day decide on.
VARYING = {"method_s": None, "loop_s": None, "plant_s": None, "date": ""}


@pytest.fixture(scope="module")
def scenarios(threebus, tmp_path_factory):
    """Files of two scenarios of the chain."""
    folder = tmp_path_factory.mktemp("scenarios")
    write_scenarios(threebus, 2, 0, folder, servable, threebus.sampling.horizon_s)
    return scenario_files(folder)


def operations(case, files, latency="0.3", method="ed", limit_s=60.0):
    """Rows of one method in one regime."""
    loaded = load_scenarios(files, case)
    chosen = method, Settings("every=1" if method == "ed" else "default")
    return make_operations(case, loaded, chosen, ["TO"], LoopOptions(), latency, limit_s)


@pytest.fixture(scope="module")
def first_run(threebus, scenarios, tmp_path_factory):
    """Rows of both scenarios, and the folder that holds them."""
    folder = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Workers, "imap", answers_here)
        return operate(threebus, operations(threebus, scenarios), OnlineResults(folder)), folder


def test_rows_hold_all_that_is_judged(threebus, first_run):
    """Costs over hindsight, counts, and a trajectory that has them."""
    rows, folder = first_run
    results = OnlineResults(folder)
    assert [results.table.rows[row.key] for row in rows] == rows
    for row in rows:
        assert (row.plans, row.late, row.failed, row.error) == (6, 0, 0, "")
        assert (row.latency_s, row.latency_source, row.period_s) == (0.3, "given", 1.0)
        best = results.hindsight.rows[row.scenario, "TO", "lossless"]
        assert best.method == "ded-slp"
        assert best.max_excess_hz < 1e-6
        assert row.increase_percent == pytest.approx(100 * (row.objective / best.objective - 1))
        assert row.max_excess_hz > row.mean_excess_hz >= 0
        assert row.loop_s > row.plant_s > 0
        assert (row.settings, row.plant, row.method_version) == ("every=1", "lossless", 1)
        kept = read_arrays(results.files.trajectory(row.key))[0]
        np.testing.assert_allclose(kept["t"], np.arange(61) * 0.1, atol=1e-12)
        assert kept["omega"].shape == (61, len(threebus.generators))
        look = read_arrays(results.files.hindsight_trajectory(row.scenario, "TO", "lossless"))[0]
        assert np.abs(look["omega"]).max() <= threebus.omega_bound("TO") + 1e-5


def test_a_given_latency_gives_the_same_to_the_last_bit(threebus, scenarios, first_run, tmp_path):
    """Rows but for the clock, and trajectories; with two workers, too."""
    rows, folder = first_run
    again = operate(threebus, operations(threebus, scenarios), OnlineResults(tmp_path), workers=2)
    for old, new in zip(rows, again, strict=True):
        assert dataclasses.replace(old, **VARYING) == dataclasses.replace(new, **VARYING)
        places = (OnlineResults(f).files.trajectory(old.key) for f in (folder, tmp_path))
        assert len({place.read_bytes() for place in places}) == 1


@pytest.mark.usefixtures("inline")
def test_what_is_there_is_not_made_again(threebus, scenarios, first_run, tmp_path):
    """But a row that a killed process has torn, and all with another limit."""
    shutil.copytree(first_run[1], tmp_path, dirs_exist_ok=True)
    results, made, wanted = OnlineResults(tmp_path), [], operations(threebus, scenarios)
    assert operate(threebus, wanted, results, on_row=made.append) == first_run[0]
    assert made == []
    text = results.files.online.read_text()
    results.files.online.write_text(text[:-20])
    results = OnlineResults(tmp_path)
    assert len(results.table.rows) == 1
    again = operate(threebus, wanted, results, on_row=made.append)
    assert len(made) == 1
    assert [row.objective for row in again] == [row.objective for row in first_run[0]]
    stored = [row.objective for row in results.hindsight.rows.values()]
    old = [dataclasses.replace(row, objective=1.0) for row in results.hindsight.rows.values()]
    results.hindsight.add([dataclasses.replace(row, method_version=row.method_version + 1) for row in old])
    operate(threebus, wanted, results)  # hindsight of another version does not count
    assert [row.objective for row in results.hindsight.rows.values()] == stored
    changed = operations(threebus, scenarios, limit_s=30.0)
    assert not any(results.table.made_from(o.row.key, o.row.fingerprint) for o in changed)


@pytest.mark.usefixtures("inline")
def test_faults_are_in_the_row(threebus, scenarios, tmp_path):
    """A method that raises every third time."""
    chosen = operations(threebus, scenarios[:1], method=f"{FAULTY}:raises")
    (row,) = operate(threebus, chosen, OnlineResults(tmp_path))
    assert (row.plans, row.late, row.failed) == (6, 0, 2)
    assert row.method == f"{FAULTY}.raises"
    assert "no idea how" in row.error
    assert row.objective is not None


@pytest.mark.usefixtures("inline")
def test_a_full_disk_is_no_fault_of_the_method(threebus, scenarios, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ded_bench.run.online.operation.keep_trajectory", full)
    chosen, results = operations(threebus, scenarios[:1]), OnlineResults(tmp_path)
    with pytest.raises(OSError, match="No space"):
        operate(threebus, chosen, results, look_back=False)
    assert not results.table.rows


@pytest.mark.usefixtures("inline")
def test_no_plan_is_no_result(threebus, scenarios, tmp_path, capsys):
    """Exit code 1, the reason in a line, the traceback in a log; one that is not timed is timed first."""
    line = ["online", "--case", str(CASE_FILES["threebus"]), "--regime", "TO", "--out", str(tmp_path)]
    line += ["--scenario", str(scenarios[0]), "--method"]
    assert main([*line, f"{FAULTY}:lost", "--latency", "0"]) == 1
    (row,) = OnlineResults(tmp_path).table.rows.values()
    assert (row.objective, row.failed) == (None, row.plans)
    said = capsys.readouterr().err
    assert "every plan failed: KeyError: 'power' (faulty_methods.py, line" in said
    log = (tmp_path / "failures.log").read_text()
    assert "Traceback (most recent call last)" in log
    assert main([*line, f"{FAULTY}:lost", "--latency", "0"]) == 1  # what failed is tried again
    assert len((tmp_path / "failures.log").read_text()) > len(log)
    assert main([*line, f"{FAULTY}:lost"]) == 1
    assert "has no answer to any of them: KeyError" in capsys.readouterr().err
    assert main([*line, "ed"]) == 0
    found = [r for r in OnlineResults(tmp_path).table.rows.values() if r.method == "ed"]
    assert found[0].latency_source == "timing"
    assert main([*line, "ed"]) == 0  # and not a second time
    assert len(OnlineResults(tmp_path).table.rows) == 2


def test_less_than_hindsight_says_why(capsys):
    """Hindsight keeps the bound."""
    row = OnlineRow(
        "s", "TO", "ed", "default", 1.0, 0.0, "announced", True, True, objective=1.0, max_excess_hz=1e-3
    )
    for over in (-0.5, 0.5):
        _print_row(dataclasses.replace(row, increase_percent=over))
    first, second = capsys.readouterr().out.splitlines()
    assert "-0.5000 % over hindsight (less than it, since the bound is exceeded)" in first
    assert "exceeded" not in second


def test_the_latency_is_the_median_of_build_and_solve(threebus, scenarios, tmp_path):
    """Of the first folder that timed it; warm-ups, failures and other settings do not count."""
    times = [(0, 9.0, ""), (1, 0.1, ""), (2, 0.3, ""), (3, 0.2, ""), (4, 7.0, "failed")]
    rows = [
        TimingRow("r", n, "TO", "ed", s, "i", "Feasible", 0.25, 5.0, solve, error=error, case="threebus")
        for s, more in (("every=1", 0.0), ("every=10", 1.0))
        for n, solve, error in ((n, solve + more, error) for n, solve, error in times)
    ]
    older = [dataclasses.replace(rows[1], solve_s=9.0, method_version=99)]
    found = timed(threebus, scenarios, tmp_path, [*rows, *older], "ed", Settings("every=1"))
    assert found == pytest.approx(0.45)


def timed(case, scenarios, folder, rows, method, settings) -> float:
    """The latency of a method, and that the row says where it is from."""
    TIMING.write(folder / "timing.csv", rows)
    own = dataclasses.replace(settings, search=(folder / "nothing", folder))
    loaded = load_scenarios(scenarios[:1], case)
    (found,) = make_operations(case, loaded, (method, own), ["TO"], LoopOptions(), "timing")
    assert found.row.latency_source == "timing"
    assert found.row.settings == settings.options
    return found.options.latency_s


def test_the_latency_is_that_of_the_model_of_the_same_name(threebus, scenarios, tmp_path):
    row = TimingRow("r", 1, "TO", "ded-ko-knots", "default", "i", "Optimal", 0.25, 5.0, 0.5, case="threebus")
    rows = [
        dataclasses.replace(row, model="linear@00"),
        dataclasses.replace(row, model="koopman@00", build_s=9.0),
    ]
    settings = Settings(model="linear")
    found = timed(threebus, scenarios, tmp_path, rows, "ded-ko-knots", settings)
    assert found == pytest.approx(0.75)


def test_rows_and_files_of_models_and_plants_stand_side_by_side(tmp_path):
    """Nothing that a row was made with is left out of its key, or of the name of its trajectory."""
    key = OnlineKey("s", "TO", "m", "margin=0.25", "linear@0a", "", 1.0, 0.3, "announced", True, True)
    changes = {
        "settings": "default",
        "model": "trajectory@0a",
        "policy": "p@0b",
        "plant": "other",
        "warm": False,
    }
    keys = [key, *(key._replace(**{name: value}) for name, value in changes.items())]
    assert len({OnlineResults(tmp_path).files.trajectory(k) for k in keys}) == len(keys)


@pytest.mark.usefixtures("inline")
def test_another_plant_has_rows_and_hindsight_of_its_own(threebus, scenarios, tmp_path, lagged):
    loaded, chosen = load_scenarios(scenarios[:1], threebus), ("ed", Settings("every=1"))
    rows = [
        operate(
            threebus,
            make_operations(threebus, loaded, chosen, ["TO"], LoopOptions(), "0", plant=plant),
            OnlineResults(tmp_path),
        )[0]
        for plant in (None, "lagged")
    ]
    assert [row.plant for row in rows] == ["lossless", "lagged"]
    assert rows[0].fingerprint != rows[1].fingerprint
    assert rows[0].objective != rows[1].objective
    assert len(OnlineResults(tmp_path).hindsight.rows) == 2


@pytest.mark.usefixtures("inline")
def test_the_command(scenarios, tmp_path, capsys):
    """Rows are printed as they are made, once."""
    line = ["online", "--case", str(CASE_FILES["threebus"]), "--method", "ed", "--set", "every=1"]
    line += ["--regime", "TO", "--scenario", str(scenarios[0]), "--out", str(tmp_path)]
    assert main([*line, "--latency", "zero"]) == 0
    assert "over hindsight" in capsys.readouterr().out
    assert main([*line, "--latency", "0"]) == 0
    assert "% over hindsight" not in capsys.readouterr().out
    assert main([*line, "--latency", "0,1.5", "--forecast", "announced,perfect"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("% over hindsight") == 3
    assert printed.splitlines()[-1].split()[:4] == ["TO", "ED", "[every=1]", "1.5"]  # a table ends it
    rows = OnlineResults(tmp_path).table.rows
    assert {(key.latency_s, key.forecast) for key in rows} == set(
        itertools.product((0.0, 1.5), ("announced", "perfect"))
    )


@pytest.mark.usefixtures("inline")
def test_hindsight_of_other_loads_is_compared_with_nothing(threebus, scenarios, first_run, tmp_path):
    shutil.copy(first_run[1] / "hindsight.csv", tmp_path)
    results = OnlineResults(tmp_path)
    results.hindsight.add(
        [dataclasses.replace(r, fingerprint="other") for r in results.hindsight.rows.values()]
    )
    rows = operate(threebus, operations(threebus, scenarios), results, look_back=False)
    assert [row.increase_percent for row in rows] == [None, None]


def test_planners_cannot_draw_the_scenario_again(threebus, scenarios):
    (scenario, *_), known = load_scenarios(scenarios, threebus), []
    run_loop(threebus, scenario, lambda now, last: known.append(now) or Planned(None), LoopOptions())
    assert {instance.seed for instance in known} == {()}


def test_a_scenario_that_is_not_balanced_is_refused(scenarios, tmp_path, capsys):
    """A stranger's file, as instances are."""
    text = json.loads(scenarios[0].read_text())
    text["initial"]["omega"] = dict.fromkeys(text["initial"]["omega"], 60.0)
    place = tmp_path / "mine.json"
    place.write_text(json.dumps(text))
    line = ["online", "--case", str(CASE_FILES["threebus"]), "--method", "ed", "--latency", "0"]
    assert main([*line, "--scenario", str(place), "--out", str(tmp_path / "out")]) == 2
    assert "not the frequency in Hz" in capsys.readouterr().err


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["--latency", "soon"], "--latency"),
        (["--latency", "0,-1"], "neither timing nor zero nor a number"),
        (["--method", "nobody"], "unknown method"),
        (["--regime", "XX"], "unknown regime"),
        (["--set", "every=0"], "--set: every"),
        (["--scenario", "nowhere.json"], "cannot be read"),
    ],
)
def test_bad_input_is_one_line(scenarios, tmp_path, capsys, change, said):
    """Exit code 2, and no table."""
    line = ["online", "--case", str(CASE_FILES["threebus"]), "--method", "ed", "--regime", "TO"]
    line += ["--latency", "0", "--scenario", str(scenarios[0]), "--out", str(tmp_path / "out"), *change]
    assert main(line) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
