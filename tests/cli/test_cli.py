"""The command line as a user meets it: the road on a small case, kill -9, results that are checked."""

from __future__ import annotations

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

from ded_bench.cli import main
from ded_bench.results.rows import Results, Row
from tests.cli.command_line import SOLVE, refused
from tests.conftest import CASE_FILES
from tests.detailed_cases import MIXED
from tests.run.test_pool import runs, wait_until

#: So much processor time may pass before the first line of a command, s: more than twice what it takes alone,
#: since a core that others share counts more.
FIRST_LINE_S = 5.0


@pytest.mark.usefixtures("inline")
def test_solve_prints_one_object_per_row_and_score_agrees(
    problem: Path, instance_file: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    arguments = ["solve", "--method", "ded", "--regime", "NO,TO", "--instance", str(instance_file)]
    assert main([*arguments, "--out", str(out)]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row["regime"] for row in rows} == {"NO", "TO"}
    for row in rows:
        assert row["status"] == "Optimal"
        with np.load(row["schedule"], allow_pickle=False) as archive:
            table, header = archive[row["schedule_member"]], ",".join(archive["columns"])
        np.savetxt(tmp_path / "s.csv", table, "%.17g", ",", header=header, comments="")
        score = ["score", "--instance", str(instance_file), "--schedule", str(tmp_path / "s.csv"), "--json"]
        assert main([*score, "--regime", row["regime"]]) == 0
        verdict = json.loads(capsys.readouterr().out)
        for name in ("objective", "freq_violation_hz", "ramp_violation", "bound_violation"):
            assert verdict[name] == pytest.approx(row[name], rel=1e-9, abs=1e-12)
        assert verdict["feasible"] is row["feasible"]
    assert main([*arguments, "--out", str(out)]) == 0
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == rows
    assert len(Results(out).rows) == 2


@pytest.mark.usefixtures("inline")
def test_solve_ends_with_a_table(problem: Path, tmp_path: Path, capsys) -> None:
    """One line for each method, own ones first; why one failed, and where the whole traceback is."""
    methods = "ed,tests.run.online.faulty_methods:lost"
    arguments = ["solve", "--method", methods, "--regime", "NO", "--case", str(problem), "--limit", "1"]
    assert main([*arguments, "--out", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    heading, lost, ed, note = out.splitlines()
    assert heading.split()[:5] == ["Regime", "Method", "n", "solved", "feasible"]
    assert lost.split() == ["NO", "tests.run.online.faulty_methods.lost", "1", "0", "0", "–", "0", "–", "–"]
    assert ed.split()[:4] == ["NO", "ED", "1", "1"]
    assert "gaps are to the best feasible schedule" in note or "gaps are to DED (SLP)" in note
    assert "faulty_methods.lost NO, 1 time: KeyError: 'power' (faulty_methods.py, line 31, in lost: " in err
    log = (tmp_path / "failures.log").read_text()
    assert log.startswith("tests.run.online.faulty_methods.lost NO threebus-")
    assert "Traceback (most recent call last)" in log


@pytest.mark.usefixtures("inline")
def test_what_is_finished_is_told_where_nothing_may_be_written(
    problem: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = ["solve", "--method", "ed", "--regime", "NO", "--case", str(problem), "--out", str(tmp_path)]
    assert main(solve) == 0
    told = capsys.readouterr().out
    monkeypatch.setattr("ded_bench.run.runner.run", None)
    assert main(solve) == 0
    assert capsys.readouterr().out == told


def test_rows_of_validation_draws_are_judged_on_these(tmp_path: Path, capsys) -> None:
    """On an island, too, where a draw is balanced, and drawn again if it cannot be served."""
    here = ["--case", str(MIXED), "--regime", "TO", "--out", str(tmp_path)]
    road = ["solve", "--method", "ed", "--set", "every=30", "--split", "validation", "--limit", "1", *here]
    assert main(road) == 0
    assert main(["score", "--results", str(tmp_path), "--case", str(MIXED)]) == 0
    assert "1 row checked" in capsys.readouterr().out


def test_rows_of_an_edited_case_are_told_from_those_before(problem: Path, tmp_path: Path, capsys) -> None:
    place = shutil.copytree(problem, tmp_path / "edited")
    road = ["solve", "--case", str(place), "--method", "ed", "--regime", "TO", "--limit", "1"]
    road += ["--out", str(tmp_path / "out")]
    assert main(road) == 0
    assert "different problem files" not in capsys.readouterr().out
    data = json.loads((place / "case.json").read_text())
    data["regimes"]["TO"]["omega_hz"] *= 2.0
    (place / "case.json").write_text(json.dumps(data))
    assert main([*road, "--set", "every=30"]) == 0
    assert "the folder's rows are of different problem files" in capsys.readouterr().out


def test_kill_in_the_middle_loses_nothing(problem: Path, tmp_path: Path) -> None:
    """First one of the workers is killed, then the main process, whose workers go with it."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "ded_bench", "solve", "--method", "tests.run.online.faulty_methods:slow"]
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


def test_paths_are_those_of_the_working_directory(tmp_path: Path, monkeypatch, capsys) -> None:
    """An instance without a case beside it is of a shipped one."""
    shipped = CASE_FILES["9bus"].parent / "instances" / "9bus-0007.json"
    (tmp_path / "alone.json").write_bytes(shipped.read_bytes())
    (tmp_path / "s.csv").write_text("t,P_2,P_3\n0,2.03748309,0.56635889\n60,2.03748309,0.56635889\n")
    monkeypatch.chdir(tmp_path)
    score = ["score", "--instance", "alone.json", "--schedule", "s.csv", "--regime", "TO", "--json"]
    assert main(score) == 0
    assert json.loads(capsys.readouterr().out)["initial_violation"] == 0.0


@pytest.mark.usefixtures("inline")
def test_anyone_can_check_a_results_folder(problem: Path, tmp_path: Path, capsys) -> None:
    """Exit code 0 if every kept schedule says what its row says, else 1 and a line for each that does not."""
    out = tmp_path / "out"
    assert main([*SOLVE, "--case", str(problem), "--split", "all", "--out", str(out)]) == 0
    results = Results(out)
    first, second, *_ = results.rows.values()
    results.archive(first).drop([first.member])
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


@pytest.mark.parametrize(
    "arguments",
    [
        ("cases", "9bus", "--count", "1"),
        ("bench", "--method", "ded", "--instances", "1", "--results", "results"),
        ("report", "--results", "results"),
        ("train-ko", "--results", "results"),
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


def test_only_policies_that_need_a_koopman_model_ask_for_one(
    problem: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    """`ded-admm` is trained on the grid itself."""
    for name, small in (("STEPS", 1), ("ROWS", 400), ("TIGHT", (3, 0))):
        monkeypatch.setattr(f"ded_bench.methods.admm.admm_training.{name}", small)
    where = ("--case", str(problem), "--regime", "TO", "--limit", "1", "--epochs", "1", "--results")
    assert main(["train-dpc", "--method", "ded-dpc", *where, str(tmp_path)]) == 2
    assert "not there yet" in capsys.readouterr().err
    assert main(["train-dpc", "--method", "ded-admm", *where, str(tmp_path)]) == 0
    assert (tmp_path / "policies" / "ded-admm-TO.safetensors").is_file()


def test_a_training_that_cannot_be_leaves_the_others(problem: Path, tmp_path: Path, capsys, inline) -> None:
    """Of one command: the policy of the second method is there already, the first has no model."""
    there = tmp_path / "policies" / "ded-admm-TO.safetensors"
    there.parent.mkdir()
    there.touch()
    where = ("--case", str(problem), "--regime", "TO", "--results", str(tmp_path))
    assert main(["train-dpc", "--method", "ded-dpc,ded-admm", *where]) == 2
    out, err = capsys.readouterr()
    assert "ded-dpc TO: --model: koopman: not there yet" in err
    assert f"{there} is there already" in out


def test_path_says_where_a_case_lies(problem: Path, capsys, monkeypatch, tmp_path: Path) -> None:
    """Shipped ones by name, from any folder; what is no case is refused with the names of those that are."""
    monkeypatch.chdir(tmp_path)
    for name in ("9bus", problem):
        assert main(["path", str(name)]) == 0
        folder = Path(capsys.readouterr().out.rstrip("\n"))
        assert folder.is_absolute()
        assert (folder / "case.json").is_file()
    assert "no such case (shipped: 140bus" in refused(capsys, "path", "10bus")
