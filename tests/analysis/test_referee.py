"""ANDES as referee: verdict, files, rows and resuming with a stand-in in its place; itself where present."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ded_bench.analysis.referee import ABSOLUTE_HZ, REFEREE, grid_data, judged, referee, run_data, verdict
from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import IslandRegime, Regime
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results, Row
from tests.detailed_cases import MIXED

#: An interpreter with ANDES, to be tried with; this one, unless told otherwise.
PYTHON = os.environ.get("DED_BENCH_ANDES_PYTHON", sys.executable)

#: Answers as `andes_run` does: all machines at 0.001 rad/s, and no more voltages where the first set-point is
#: above 0.9 pu; notes each run.
STAND_IN = """#!{python}
import json, sys
import numpy as np
asked = json.load(sys.stdin)
run = asked["run"]
with open({log!r}, "a") as file:
    print(json.dumps(run), file=file)
failed = max(run["set_points"]["south"]) > 0.9
n = round(run["horizon_s"] / run["dt_s"]) // 2 + 1
np.save(sys.argv[2], np.full((n, len(asked["grid"]["machines"]["machines"])), 0.001))
print(json.dumps({{"andes": "0", "error": "no solution" if failed else ""}}))
"""


@pytest.fixture(scope="module")
def mixed() -> Case:
    return Case.load(MIXED)


def ramping(case: Case, quiet_instance, **changes) -> tuple[Instance, Schedule]:
    """Four seconds, in which loads ramp and set-points bend, with secondary control in their midst."""
    load = {
        bus: {"initial": value, "start": 0.53, "duration": 2.0, "rate": 0.01 * value}
        for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
    }
    instance = quiet_instance(case, horizon_s=4.0, load=load, **changes)
    step = 0.02 * np.resize([1.0, -0.5], len(case.generators))
    p = instance.p_initial(case) + np.array([0.0, 1.0, 0.3])[:, None] * step
    return instance, Schedule(np.array([0.0, 2.507, 4.0]), p)


def executable(path: Path, text: str) -> str:
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.fixture
def stand_in(tmp_path: Path) -> tuple[str, Path]:
    """A program in the place of an interpreter with ANDES, and the log of its runs."""
    log = tmp_path / "runs.txt"
    return executable(tmp_path / "andes", STAND_IN.format(python=sys.executable, log=str(log))), log


@pytest.fixture
def results(mixed: Case, quiet_instance, tmp_path: Path) -> tuple[Results, dict[str, Instance]]:
    """Schedules of two methods for one instance, and of one of them for two more."""
    found, instances = Results(tmp_path / "results"), {}
    for name, methods in (("a", ["ed"]), ("b", ["ed", "ded-slp"]), ("c", ["ed"])):
        instances[name], schedule = ramping(mixed, quiet_instance, id=name)
        for method in methods:
            row = Row(name, "test", "NO", method, "default", "Feasible", case=mixed.id, fingerprint="f")
            found.keep(row, schedule, mixed)
    return found, instances


# The verdict.


def test_a_peak_is_confirmed_within_its_allowance() -> None:
    """Two per cent of a large bound, 0.05 mHz of a small one; the end counts at the last time only."""
    inertia, rad = np.array([3.0, 1.0]), 2 * np.pi
    bounds = IslandRegime(mean_hz=0.01, relative_hz=0.001, end_hz=0.002).bounds(inertia)
    omega = np.full((5, 2), rad * 0.0101)
    omega[-1] = rad * 0.0019
    found = verdict(bounds, omega)
    assert found["confirmed"]
    assert found["peak_mean_hz"] == pytest.approx(0.0101)
    assert found["peak_relative_hz"] == pytest.approx(0.0, abs=1e-12)
    assert found["peak_end_hz"] == pytest.approx(0.0019)
    assert "peak_omega_hz" not in found
    for change, kept in ((0.0102 - 1e-9, True), (0.0102 + 1e-9, False)):
        assert verdict(bounds, np.vstack([omega[:1] / 0.0101 * change, omega]))["confirmed"] == kept
    for change, kept in ((ABSOLUTE_HZ - 1e-9, True), (ABSOLUTE_HZ + 1e-9, False)):
        late = np.vstack([omega, np.full(2, rad * (0.002 + change))])
        assert verdict(bounds, late)["confirmed"] == kept
        apart = np.vstack([rad * (0.001 + change) * np.array([-1.0, 3.0]) / 3.0, omega])  # mean zero
        assert verdict(bounds, apart)["confirmed"] == kept


def test_every_machine_counts_where_frequencies_themselves_are_bounded() -> None:
    bounds = Regime(omega_hz=0.05).bounds(np.ones(3))
    omega = np.zeros((4, 3))
    omega[2, 1] = -2 * np.pi * 0.0512
    assert verdict(bounds, omega) == {"peak_omega_hz": pytest.approx(0.0512), "confirmed": False}
    assert verdict(bounds, omega / 1.01)["confirmed"]


# The files.


def test_what_andes_is_told(mixed: Case, quiet_instance) -> None:
    """Powers by machine, loads as what they draw with all kinks, set-points at the schedule's own times."""
    instance, schedule = ramping(mixed, quiet_instance)
    run = json.loads(json.dumps(run_data(mixed, instance, schedule)))
    assert run["power"]["east"] == 1.5
    assert run["t"] == [0.0, 2.507, 4.0]
    np.testing.assert_array_equal(
        np.array([run["set_points"][name] for name in mixed.generators]).T, schedule.p
    )
    town = run["loads"]["town"]
    np.testing.assert_allclose([town["t"], town["p"]], [[0.0, 0.53, 2.53, 4.0], [3.2, 3.2, 3.264, 3.264]])
    grid = json.loads(json.dumps(grid_data(mixed)))
    assert grid["infinite"] is None
    assert grid["agc"]["period_s"] == 2.0
    assert [line["from"] for line in grid["network"]["lines"]]
    assert grid_data(Case.load("two-area"))["infinite"] == "3"


# Rows.


def test_rows_are_judged_once(mixed: Case, results, stand_in) -> None:
    """The instance with most schedules comes first; a run is not repeated unless its schedule changes."""
    folder, instances = results
    python, log = stand_in
    rows = referee(mixed, instances, folder, limit=1, python=python)
    assert {(row.instance, row.method) for row in rows} == {("b", "ed"), ("b", "ded-slp")}
    assert all(row.confirmed and row.andes == "0" and row.plant == "detailed" for row in rows)
    assert rows[0].peak_mean_hz == pytest.approx(0.001 / (2 * np.pi))
    rows = referee(mixed, instances, folder, python=python, workers=2)
    assert len(rows) == 4
    assert len(log.read_text().splitlines()) == 4
    row = next(row for row in folder.rows.values() if row.method == "ded-slp")
    changed = Schedule(np.array([0.0, 4.0]), np.array([[0.7, 1.8, 1.2, 1.5], [0.95, 1.8, 1.2, 1.5]]))
    folder.keep(row, changed, mixed)
    rows = referee(mixed, instances, folder, ["ded-slp"], python=python)
    assert [(row.error, row.confirmed, row.peak_mean_hz) for row in rows] == [("no solution", None, None)]
    assert len(log.read_text().splitlines()) == 5
    assert sorted(row.error for row in REFEREE.read(folder.paths.referee)) == ["", "", "", "no solution"]


def test_a_process_that_is_killed_costs_its_own_row_alone(
    mixed: Case, results, stand_in, tmp_path: Path
) -> None:
    """It is tried again the next time."""
    folder, instances = results
    python, log = stand_in
    die = f"test -e {tmp_path}/died || {{ touch {tmp_path}/died; kill -9 $$; }}"
    script = f'#!/bin/sh\n{die}\nexec {python} "$@"\n'
    rows = referee(mixed, instances, folder, python=executable(tmp_path / "dying", script))
    assert sorted(row.error for row in rows) == ["", "", "", "ANDES was ended by signal 9"]
    rows = referee(mixed, instances, folder, python=python)
    assert [row.error for row in rows] == [""] * 4
    assert len(log.read_text().splitlines()) == 4


def test_without_andes_the_command_ends_with_one_line(
    mixed: Case, results, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, instances = results
    place = tmp_path / "b.json"
    place.write_text(instances["b"].model_dump_json(by_alias=True))
    bare = executable(tmp_path / "bare", f'#!/bin/sh\nexec {sys.executable} -S "$@"\n')
    with pytest.raises(InputError, match="has no ANDES"):
        referee(mixed, instances, folder, python=bare)
    with pytest.raises(InputError, match="is no Python that answers"):
        referee(mixed, instances, folder, python="/bin/echo")
    shown = "referee", "--results", str(folder.folder), "--case", "39bus", "--python", bare
    assert main(list(shown)) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not folder.paths.referee.exists()


# ANDES itself.


@pytest.fixture(scope="module")
def andes_python() -> str:
    asked = subprocess.run([PYTHON, "-c", "import andes"], capture_output=True, check=False)
    if asked.returncode:
        pytest.skip("ANDES is not installed")
    return PYTHON


@pytest.mark.parametrize("place", [MIXED, "two-area"])
def test_andes_confirms_our_plant(place, andes_python: str, quiet_instance) -> None:
    """Within 1e-5 Hz, a fifth of the allowance: its trapezoidal rule has errors of that order.

    An island with every model and secondary control, and an infinite slack, there out of rest.
    """
    case = Case.load(place)
    omega = 0.01 if case.slack is not None else 0.0
    instance, schedule = ramping(case, quiet_instance)
    start = {"power": instance.initial.power, "omega": dict.fromkeys(case.generators, omega)}
    instance, schedule = ramping(case, quiet_instance, initial=start)
    found = judged(case, instance, schedule, next(iter(case.regimes)), grid_data(case), andes_python)
    assert found["difference_hz"] < 1e-5
    assert max(value for name, value in found.items() if name.startswith("peak")) > 1e-3
