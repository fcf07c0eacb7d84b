"""The command line as a user meets it: the road on a small case, kill -9, and every kind of bad input."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

import ded_bench
from ded_bench.cli import main
from ded_bench.cli.arguments import ORDER, matching
from ded_bench.cli.commands import parser
from ded_bench.cli.outputs import sweep
from ded_bench.methods import plugin
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.results import Results, Row
from tests.conftest import CASE_FILES
from tests.run.test_pool import runs, wait_until

#: So much processor time may pass before the first line of a command, twice what its user should wait, s.
FIRST_LINE_S = 4.0


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small benchmark folder on the three-bus case."""
    folder = tmp_path_factory.mktemp("problems") / "threebus"
    code = main(
        ["instances", "--case", str(CASE_FILES["threebus"].parent), "--count", "5", "--out", str(folder)]
    )
    assert code == 0
    return folder


@pytest.fixture
def instance_file(problem: Path) -> Path:
    return problem / "instances" / "threebus-0000.json"


@pytest.fixture
def schedule_file(instance_file: Path, threebus: Case, tmp_path: Path) -> Path:
    instance, case = Instance.load_file(instance_file)
    power = instance.p_initial(case)
    path = tmp_path / "mine.csv"
    Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power])).write(path, case.generators)
    return path


def run_cli(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ded_bench", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=cwd, check=False)


def test_solve_prints_one_object_per_row_and_score_agrees(
    problem: Path, instance_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["solve", "--method", "ded", "--regime", "NO,TO", "--instance", instance_file, "--out", out]
    first = run_cli(*arguments, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    rows = [json.loads(line) for line in first.stdout.splitlines()]
    assert {row["regime"] for row in rows} == {"NO", "TO"}
    for row in rows:
        assert row["status"] == "Optimal"
        scored = run_cli(
            "score",
            "--instance",
            instance_file,
            "--schedule",
            row["schedule"],
            "--regime",
            row["regime"],
            "--json",
        )
        verdict = json.loads(scored.stdout)
        for name in ("objective", "freq_violation_hz", "ramp_violation", "bound_violation"):
            assert verdict[name] == pytest.approx(row[name], rel=1e-9, abs=1e-12)
        assert verdict["feasible"] is row["feasible"]
    again = run_cli(*arguments, cwd=tmp_path)
    assert [json.loads(line) for line in again.stdout.splitlines()] == rows
    assert len(Results(out).rows) == 2


def test_kill_in_the_middle_loses_nothing(problem: Path, tmp_path: Path) -> None:
    """First one of the workers is killed, then the main process, whose workers go with it."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "ded_bench", "solve", "--method", "ded", "--regime", "NO,TO"]
    command += ["--case", str(problem), "--split", "all", "--workers", "2", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    workers: list[psutil.Process] = []

    def wait_for_rows(count: int) -> None:
        deadline = time.monotonic() + 120
        while len(Results(out).rows) < count and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.01)
        workers.extend(psutil.Process(process.pid).children())

    wait_for_rows(1)
    workers[0].kill()
    wait_for_rows(2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    finished = Results(out).rows
    assert 2 <= len(finished) < 10
    wait_until(lambda: not any(runs(worker.pid) for worker in workers))
    rest = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert rest.returncode == 0, rest.stderr
    after = Results(out).rows
    assert len(after) == 10
    assert all(row.objective is not None for row in after.values())
    for key, row in finished.items():  # not solved a second time
        assert (after[key].solve_s, after[key].date) == (row.solve_s, row.date)
    assert not list(out.glob(".results.csv.*"))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must end with code 2 and one line; return the line."""
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    return err


SOLVE = ("solve", "--method", "ded", "--regime", "NO")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d | {"colour": "red"}, "colour"),
        (lambda d: {k: v for k, v in d.items() if k != "dt_s"}, "dt_s"),
        (lambda d: d | {"horizon_s": float("nan")}, "horizon_s"),
        (lambda d: d | {"horizon_s": 1.005}, "horizon_s"),
        (lambda d: d | {"cost": d["cost"] | {"s": -1.0}}, "cost.s"),
        (lambda d: d | {"load": {"town": d["load"]["town"] | {"duration": -1.0}}}, "load.town.duration"),
        (lambda d: d | {"load": {"town": d["load"]["town"] | {"initial": -100.0}}}, "load"),
        (lambda d: d | {"load": {"town": d["load"]["town"] | {"rate": -1e3, "start": 0.0}}}, "load"),
        (lambda d: d | {"case": "atlantis"}, "atlantis"),
    ],
)
@pytest.mark.parametrize("command", ["solve", "score"])
def test_bad_instances(command, change, named, instance_file, schedule_file, tmp_path, capsys) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(change(json.loads(instance_file.read_text()))))
    case = () if "atlantis" in named else ("--case", CASE_FILES["threebus"])
    if command == "solve":
        line = refused(capsys, *SOLVE, *case, "--instance", path, "--out", tmp_path / "out")
    else:
        line = refused(
            capsys, "score", *case, "--instance", path, "--schedule", schedule_file, "--regime", "NO"
        )
    assert named in line
    assert "bad.json" in line or named == "atlantis"


def test_an_edited_copy_and_wrong_units(problem: Path, instance_file: Path, tmp_path: Path, capsys) -> None:
    """Refused before anything is solved, also in a benchmark of one's own."""
    out, text = tmp_path / "out", instance_file.read_text()
    path = tmp_path / "copy.json"
    case = ("--case", problem)
    path.write_text(json.dumps(json.loads(text) | {"cost": {"s": 9.0, "plant": 1.0}}))
    line = refused(capsys, *SOLVE, *case, "--instance", path, "--out", out)
    assert "id: threebus-0000 is the name of" in line
    own = tmp_path / "own"
    shutil.copytree(problem, own)
    for change, named in (
        ({"initial": {"power": {"plant": 0.6}, "omega": {"plant": 59.9}}}, "initial.omega.plant: 59.9 rad/s"),
        ({"initial": {"power": {"plant": 60.0}, "omega": {"plant": 0.0}}}, "the power flow has no"),
    ):
        changed = own / "instances" / instance_file.name
        changed.write_text(json.dumps(json.loads(text) | change))
        line = refused(capsys, *SOLVE, "--case", own, "--split", "all", "--out", out)
        assert named in line
        assert "instance threebus-0000" in line
    assert not out.exists()


def test_a_versioned_case_is_not_changed_by_chance(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "threebus"
    shutil.copytree(CASE_FILES["threebus"].parent, folder)
    for command, wanted in (("instances", 4), ("scenarios", 2)):
        draw = [command, "--case", str(folder)]
        place = folder if command == "instances" else folder / "scenarios"
        assert main([*draw, "--count", str(wanted)]) == 0  # it has no version yet
        before = {path: path.read_bytes() for path in place.rglob("*.json")}
        capsys.readouterr()
        line = refused(capsys, *draw, "--count", "3", "--seed", "7")
        assert "--out" in line
        assert "--force" in line
        assert {path: path.read_bytes() for path in place.rglob("*.json")} == before
        lost = sorted(place.rglob("*0001.json"))[0]
        lost.unlink()
        assert main([*draw, "--count", str(wanted)]) == 0  # the same again: made whole
        assert {path: path.read_bytes() for path in place.rglob("*.json")} == before
        assert main([*draw, "--count", "3", "--seed", "7", "--out", str(tmp_path / command)]) == 0
        assert main([*draw, "--count", "3", "--seed", "7", "--force"]) == 0
        assert {path: path.read_bytes() for path in place.rglob("*.json")} != before


def test_a_report_first_scores_what_an_interruption_left(problem: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["solve", "--method", "ed", "--regime", "NO", "--case", str(problem), "--out", str(out)]) == 0
    results = Results(out)
    rows = list(results.rows.values())
    results.add([dataclasses.replace(row, objective=None, feasible=None, error="stopped") for row in rows])
    capsys.readouterr()
    assert main(["report", "--case", str(problem), "--results", str(out), "--workers", "1"]) == 0
    assert len(rows) == 1
    assert "ded-bench: 1 row solved but not scored: scored now" in capsys.readouterr().err
    assert [row.objective for row in Results(out).rows.values()] == [row.objective for row in rows]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("t,P_plant\n0.5,0.6\n6,0.6\n", "must start at 0"),
        ("t,P_plant\n0,0.6\n5,0.6\n", "must end at the horizon"),
        ("t,P_plant\n0,0.6\n0,0.6\n6,0.6\n", "increase strictly"),
        ("t,P_plant\n0,nan\n6,0.6\n", "line 2, P_plant"),
        ("t,P_7\n0,0.6\n6,0.6\n", "P_plant"),
        ("", "empty"),
    ],
)
def test_bad_schedules(text, named, instance_file, tmp_path, capsys) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    line = refused(capsys, "score", "--instance", instance_file, "--schedule", path, "--regime", "NO")
    assert "bad.csv" in line
    assert named in line


def test_bad_choices(instance_file, schedule_file, tmp_path, capsys) -> None:
    out = ("--out", tmp_path / "out")
    chosen = ("--instance", instance_file)
    assert "magic" in refused(capsys, "solve", "--method", "magic", "--regime", "NO", *chosen, *out)
    assert "'XX'" in refused(capsys, "solve", "--method", "ded", "--regime", "XX", *chosen, *out)
    assert "magic" in refused(capsys, *SOLVE, "--settings", "magic", *chosen, *out)
    assert "nowhere.json" in refused(capsys, *SOLVE, "--instance", tmp_path / "nowhere.json", *out)
    assert "--workers" in refused(capsys, *SOLVE, "--workers", "0", *chosen, *out)
    both = ("--workers", "1", "--scheduler", "tcp://127.0.0.1:1")
    assert "not allowed with" in refused(capsys, *SOLVE, *both, *chosen, *out)
    assert "--time-limit" in refused(capsys, *SOLVE, "--time-limit", "nan", *chosen, *out)
    assert "'XX'" in refused(capsys, "score", *chosen, "--schedule", schedule_file, "--regime", "XX")
    assert "train-ko" in refused(capsys, "solve", "--method", "ded-ko", "--regime", "NO", *chosen, *out)
    assert "COMMAND" in refused(capsys)
    assert not (tmp_path / "out").exists()


def test_errors_do_not_depend_on_the_working_directory(instance_file: Path, tmp_path: Path) -> None:
    shipped = CASE_FILES["9bus"].parent / "instances" / "9bus-0007.json"
    copy = tmp_path / "alone.json"
    copy.write_bytes(shipped.read_bytes())  # no case beside it: the shipped one is meant
    schedule = tmp_path / "s.csv"
    schedule.write_text("t,P_2,P_3\n0,2.03748309,0.56635889\n60,2.03748309,0.56635889\n")
    done = run_cli(
        "score", "--instance", "alone.json", "--schedule", "s.csv", "--regime", "TO", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["initial_violation"] == 0.0


def test_anyone_can_check_a_results_folder(problem: Path, tmp_path: Path, capsys) -> None:
    """Exit code 0 if every kept schedule says what its row says, else 1 and a line for each that does not."""
    out = tmp_path / "out"
    assert main([*SOLVE, "--case", str(problem), "--split", "all", "--out", str(out)]) == 0
    results = Results(out)
    first, second, *_ = results.rows.values()
    results.schedule_path(first.key).unlink()
    check = ["score", "--results", str(out), "--case", str(problem)]
    capsys.readouterr()
    assert main(check) == 0
    said = capsys.readouterr().out
    summary = f"4 rows checked in {results.path}, 0 differences, 1 row without a kept schedule\n"
    assert said == summary
    results.add([dataclasses.replace(second, objective=second.objective * (1 + 1e-8))])
    assert main([*check, "--json"]) == 1
    out_text, err = capsys.readouterr()
    assert len([json.loads(line) for line in out_text.splitlines()]) == 4
    assert f"ded default NO {second.instance}: objective" in err
    assert main([*check, "--update"]) == 0
    assert main(check) == 0
    again = [*SOLVE, "--case", str(problem), "--split", "all", "--out", str(out)]
    capsys.readouterr()
    assert main(again) == 0  # a scored row is finished, though its schedule is not kept
    assert "5 there already" in capsys.readouterr().err


def test_a_results_folder_that_cannot_be_checked(problem: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    for folder in ("nowhere", "file", "empty"):
        assert folder in refused(capsys, "score", "--results", tmp_path / folder)
    (tmp_path / "empty" / "results.csv").write_text("a,b\n1,2\n")
    assert "(found: a, b)" in refused(capsys, "score", "--results", tmp_path / "empty")
    Results(tmp_path / "odd").add([Row("x", "test", "NO", "ded", "default", "Optimal", case="atlantis")])
    assert "atlantis" in refused(capsys, "score", "--results", tmp_path / "odd")
    assert "--update" in refused(capsys, "score", "--schedule", "a.csv", "--regime", "NO", "--update")
    assert "--regime" in refused(capsys, "score", "--schedule", "a.csv")


@pytest.mark.parametrize("place", ["file", "file/below", "/proc/none"])
def test_a_folder_that_cannot_be_made(place: str, instance_file: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / place
    assert str(place) in refused(capsys, *SOLVE, "--instance", instance_file, "--out", out)
    assert place in refused(capsys, "train-ko", "--case", CASE_FILES["threebus"].parent, "--out", out / "k")


def test_a_disk_that_is_full(monkeypatch: pytest.MonkeyPatch, instance_file, tmp_path: Path, capsys) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert main([*SOLVE, "--instance", str(instance_file), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said == ["ded-bench: 1 row to solve", "ded-bench: No space left on device"]


def test_half_written_files_do_not_stay(tmp_path: Path) -> None:
    """Those that a killed process left, not those that another one is writing now, nor anything else."""
    kept = [tmp_path / ".lock", tmp_path / "results.csv", tmp_path / "schedules" / ".x.csv.gz.abcd1234"]
    left = [tmp_path / ".results.csv.a_b1c2d3", tmp_path / "schedules" / "ded" / ".a.csv.gz.12345678"]
    for path in (*kept, *left):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for path in (*kept[:2], *left):
        os.utime(path, (0, 0))
    sweep(tmp_path)
    assert [path.exists() for path in (*kept, *left)] == [True, True, True, False, False]


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"ded-bench {ded_bench.__version__}\n"
    assert ded_bench.__version__.count(".") == 2


def test_every_command_has_help() -> None:
    overview = run_cli("--help").stdout
    assert max(map(len, overview.splitlines())) <= 80
    listed = [line.split()[0] for line in overview.splitlines() if line.startswith("    ") and line[4] != " "]
    road = ["cases", "instances", "train-ko", "solve", "train-dpc", "bench", "report"]
    assert listed[: len(road)] == road
    assert listed == sorted(listed, key=ORDER.index)  # none is missing there


def shown_help(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_help_tells_every_option_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    commands = parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    for name, command in commands.items():
        text = shown_help(name, capsys)
        for action in command._actions:
            assert action.help, (name, action.dest)
            default = action.default
            if action.option_strings and default not in (None, argparse.SUPPRESS) and default is not False:
                told = ",".join(default) if isinstance(default, tuple) else default
                assert f"default: {told}" in text, (name, action.dest)


def test_help_lists_methods_and_settings(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Those of other packages too; one that cannot be imported says so, and the help goes on."""
    targets = {"flat": "tests.strange_methods:prepare", "gone": "no.such.module:solve"}
    monkeypatch.setattr(plugin, "installed", lambda: targets)
    for command in ("solve", "online", "bench", "train-dpc"):
        text = shown_help(command, capsys)
        for method in METHODS.values():
            assert f"{method.name} {', '.join(method.settings)}" in text
        assert "flat default" in text
        assert "gone cannot be used: " in text


def test_people_hear_at_once_what_a_command_does(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the imports of the command itself; a pipe hears nothing but the answer."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert main(["cases"]) == 0
    assert capsys.readouterr().err.startswith("ded-bench: list the shipped cases")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    assert main(["cases"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ("cases", "9bus", "--count", "1"),
        ("score", "--results", "results"),
        ("bench", "--method", "ded", "--instances", "1", "--results", "results"),
        ("report", "--results", "results"),
        ("train-ko", "--results", "results"),
        ("solve", "--help"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_pipe_hears_in_time_what_is_about_to_take_long(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """Processor time, not the clock's: other tests share the core."""
    Results(tmp_path / "results").add(
        [Row("9bus-0001", "test", "NO", "ded", "default", "Optimal", case="9bus")]
    )
    command = [sys.executable, "-m", "ded_bench", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=tmp_path) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        used = psutil.Process(process.pid).cpu_times()
        process.terminate()
    assert first.strip()
    assert used.user + used.system < FIRST_LINE_S, first


def test_a_locale_without_arrows(tmp_path: Path) -> None:
    """`compare` prints them between what was and what is."""
    row = Row(*("x-0", "test", "NO", "ded", "default", "Optimal"), objective=1.0, case="x", feasible=True)
    Results(tmp_path / "a").add([row])
    Results(tmp_path / "b").add([dataclasses.replace(row, status="Infeasible", feasible=False)])
    ascii_only = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "ded_bench", "compare", "a", "b"]
    done = subprocess.run(command, capture_output=True, cwd=tmp_path, env=ascii_only, check=False)
    assert done.returncode == 1, done.stderr
    assert b"Optimal ? Infeasible" in done.stdout


def test_windows_is_told_plainly() -> None:
    code = "import sys; sys.platform = 'win32'; import ded_bench.cli"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "needs Linux or macOS" in done.stderr


def test_settings_are_named_or_matched() -> None:
    known = {"default": {}, "steps25": {}, "steps100": {}}
    assert matching("default", known) == ["default"]
    assert matching("steps*,default,steps25", known) == ["steps25", "steps100", "default"]
    assert matching("nope", known) == ["nope"]  # its method says what is wrong
    assert matching("nope*", known) == []


@pytest.mark.parametrize(
    ("options", "problem_said"),
    [
        (("--method", "ded-dpc", "--out", "p.safetensors"), "name one method, settings and regime"),
        (("--settings", "nope*"), "matches no settings"),
        (("--method", "ded", "--regime", "TO"), "is not trained"),
    ],
)
def test_trainings_that_cannot_be_meant(capsys, tmp_path: Path, monkeypatch, options, problem_said) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train-dpc", *options]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert problem_said in err
