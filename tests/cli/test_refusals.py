"""Bad input of every kind: exit code 2 and one line that says what is wrong."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from ded_bench.cli import main
from ded_bench.problem.benchmark import instance_file as instance_file_of
from ded_bench.results.rows import Results, Row
from ded_bench.run.pool import Workers
from tests.cli.command_line import SOLVE, refused
from tests.conftest import CASE_FILES
from tests.detailed_cases import MIXED

pytestmark = pytest.mark.usefixtures("inline")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d | {"horizon_s": float("nan")}, "horizon_s"),
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


@pytest.mark.parametrize("command", [("cases",), ("instances", "--case"), ("scenarios", "--case")])
def test_a_case_whose_horizon_is_no_number_of_steps(command: tuple[str, ...], tmp_path: Path, capsys) -> None:
    document = json.loads(CASE_FILES["threebus"].read_text())
    document["sampling"]["dt_s"] *= 0.7
    (tmp_path / "case.json").write_text(json.dumps(document))
    assert "horizon_s: must be a whole multiple of dt_s" in refused(capsys, *command, tmp_path)


@pytest.mark.parametrize("kind", ["instances", "scenarios"])
def test_a_folder_named_by_out_is_not_drawn_over(kind: str, problem: Path, tmp_path: Path, capsys) -> None:
    """Neither by another number nor by another seed, unless by force."""
    draw = [kind, "--case", str(problem), "--out", str(tmp_path / "drawn"), "--count"]
    assert main([*draw, "3"]) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    capsys.readouterr()
    for other in (["2"], ["3", "--seed", "7"]):
        assert "--force" in refused(capsys, *draw, *other)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before
    assert main([*draw, "2", "--force"]) == 0
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} != before


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
        sorted(place.rglob("*0001.json"))[0].unlink()
        assert main([*draw, "--count", str(wanted)]) == 0  # the same again: made whole
        assert {path: path.read_bytes() for path in place.rglob("*.json")} == before
        assert main([*draw, "--count", "3", "--seed", "7", "--out", str(tmp_path / command)]) == 0
        assert main([*draw, "--count", "3", "--seed", "7", "--force"]) == 0
        assert {path: path.read_bytes() for path in place.rglob("*.json")} != before


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("t,P_plant\n0,0.6\n5,0.6\n", "must end at the horizon"),
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
    assert "lead" in refused(capsys, "solve", "--method", "ed", "--set", "lead=on", *chosen, *out)
    assert "magic" in refused(capsys, *SOLVE, "--settings", "magic", *chosen, *out)
    assert "nowhere.json" in refused(capsys, *SOLVE, "--instance", tmp_path / "nowhere.json", *out)
    assert "--workers" in refused(capsys, *SOLVE, "--workers", "0", *chosen, *out)
    both = ("--workers", "1", "--scheduler", "tcp://127.0.0.1:1")
    assert "not allowed with" in refused(capsys, *SOLVE, *both, *chosen, *out)
    assert "--delta" in refused(capsys, "certify", "--delta", "5")
    for limit in ("nan", "1e16"):  # no table could be read with the latter
        assert "--time-limit" in refused(capsys, *SOLVE, "--time-limit", limit, *chosen, *out)
    assert "'XX'" in refused(capsys, "score", *chosen, "--schedule", schedule_file, "--regime", "XX")
    said = refused(capsys, "solve", "--method", "ded-ko-knots", "--regime", "NO", *chosen, *out)
    assert "run `ded-bench train-ko --case" in said
    assert "or use --model trajectory" in said
    assert "COMMAND" in refused(capsys)
    assert not (tmp_path / "out").exists()


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
    for option in ("--regime", "--limit", "--name", "--out"):
        line = refused(capsys, "score", "--results", tmp_path / "odd", option, "1")
        assert line.startswith(f"ded-bench: {option}: is not for --results")
    assert "--limit" in refused(capsys, *SOLVE, "--instance", "9bus-0001", "--limit", "1")


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
    place = tmp_path / "out" / "schedules" / "ded" / "default" / "NO" / "columns.npy"
    assert said == ["ded-bench: 1 row to solve", f"ded-bench: {place}: No space left on device"]


def test_what_would_fill_the_memory(instance_file: Path, tmp_path: Path, capsys) -> None:
    """A pipe that never ends, a schedule of a hundred thousand rows, a load of as many points."""
    pipe, rows = tmp_path / "pipe", tmp_path / "rows.csv"
    os.mkfifo(pipe)
    rows.write_text("t,P_plant\n" + "0,0.6\n" * 100_002)
    judge = ("score", "--regime", "NO", "--instance", instance_file, "--schedule")
    assert "pipe: is no regular file" in refused(capsys, *judge, pipe)
    assert "pipe: is no regular file" in refused(capsys, *SOLVE, "--instance", pipe)
    assert "rows.csv: has more than 100000 rows" in refused(capsys, *judge, rows)
    text = json.loads(instance_file.read_text())
    load = {name: {"points": [[0.0, -1.0]] * 100_001} for name in text["load"]}
    (tmp_path / "points.json").write_text(json.dumps(text | {"schema": "ded-bench/instance/2", "load": load}))
    assert "at most 100000 items" in refused(capsys, *SOLVE, "--instance", tmp_path / "points.json")
    (tmp_path / "long.json").write_bytes(b" " * (2**26 + 1))
    assert "long.json: is larger than 64 MiB" in refused(capsys, *SOLVE, "--instance", tmp_path / "long.json")


def test_instances_and_scenarios_that_are_not_there(problem: Path, tmp_path: Path, capsys) -> None:
    """An id is as good as a file; a case without scenarios says how to draw them."""
    assert "neither a file nor" in refused(capsys, *SOLVE, "--instance", "threebus-0000")  # none is shipped
    chosen = instance_file_of(Path("threebus-0000"), str(problem))
    assert chosen == problem / "instances" / "threebus-0000.json"
    assert instance_file_of(Path("9bus-0001")).is_file()
    dotted = problem / "instances" / "my.grid-0000.json"
    dotted.write_text("{}")
    assert instance_file_of(Path("my.grid-0000"), str(problem)) == dotted
    dotted.unlink()
    line = refused(capsys, "online", "--method", "ed", "--case", problem, "--out", tmp_path)
    assert f"`ded-bench scenarios --case {problem}` draws some" in line


def test_one_line_whatever_a_name_holds(problem: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"x\\ny\\u001b[31m": 1}')
    assert "\x1b" not in refused(capsys, *SOLVE, "--case", problem, "--instance", path)


def test_nobody_listens_to_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error is closed: the exit code says what is to be said."""
    monkeypatch.setattr("sys.stderr", None)
    assert main(["path", "nowhere"]) == 2


def test_times_are_of_the_case_of_the_rows(problem: Path, tmp_path: Path, capsys) -> None:
    assert (
        main(["solve", "--method", "ed", "--case", str(problem), "--regime", "NO", "--out", str(tmp_path)])
        == 0
    )
    capsys.readouterr()
    assert main(["bench", "--case", "9bus", "--results", str(tmp_path)]) == 2
    assert "holds no rows of these methods" in capsys.readouterr().err
    assert "--method: ded: has no rows" in refused(
        capsys, "reproduce", "--results", tmp_path, "--method", "ded"
    )


@pytest.mark.parametrize("command", ["bench", "score", "online"])
def test_a_folder_that_refuses_says_so_before_the_work(command, problem, tmp_path, monkeypatch, capsys):
    case = ["--case", str(problem)]
    assert main(["solve", "--method", "ed", *case, "--regime", "NO", "--out", str(tmp_path)]) == 0
    drawn = tmp_path / "scenarios"
    assert main(["scenarios", *case, "--count", "1", "--out", str(drawn)]) == 0

    def refuses(**_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("tempfile.TemporaryFile", refuses)
    monkeypatch.setattr(Workers, "imap", None)
    online = ["--method", "ed", "--latency", "0", "--scenario", *map(str, drawn.glob("*-s*.json")), "--out"]
    words = {"bench": ["--results"], "score": ["--update", "--results"], "online": online}
    capsys.readouterr()
    assert main([command, *case, *words[command], str(tmp_path)]) == 2
    assert "cannot be written (Read-only" in capsys.readouterr().err.splitlines()[-1]


def test_interrupted_in_the_first_second(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """While libraries are imported, too: one line."""

    class Impatient:
        def find_spec(self, *_: object) -> None:
            raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "ded_bench.cli.commands")
    monkeypatch.setattr(sys, "meta_path", [Impatient(), *sys.meta_path])
    assert main(["cases"]) == 130
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "problem_said"),
    [
        (("--method", "ded-dpc", "--out", "p.safetensors"), "name one method and regime"),
        (("--method", "ded", "--regime", "TO"), "is not trained"),
        (("--method", "ded-dpc", "--device", "cuda"), "ded-dpc is trained on the CPU alone"),
        (("--method", "ded-dpc", "--case", str(MIXED)), "has no lossless network"),
        (("--method", "ded-admm", "--seed", "500000"), "must be below 500000"),
    ],
)
def test_trainings_that_cannot_be_meant(capsys, tmp_path: Path, monkeypatch, options, problem_said) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train-dpc", *options]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert problem_said in err
