"""The road of every grid: what `make report` and its relatives run, as `studies/run.py --list` says."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ded_bench.cli.commands import parser
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import REPOSITORY

STEPS = (
    *(
        "train-ko",
        "solve-baselines",
        "train-dpc",
        "solve-dpc",
        "bench",
        "report",
        "online",
        "radau",
        "models",
    ),
)
GRIDS = ("9bus", "two-area", "39bus", "68bus", "140bus", "elsewhere/mine")


def commands(step: str, case: str = "9bus", *arguments: str) -> list[list[str]]:
    """The commands of a step, without the program's name."""
    command = [sys.executable, "studies/run.py", step, "--case", case, "--list", *arguments]
    made = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return [shlex.split(line)[1:] for line in made.stdout.splitlines()]


def solved(road: list[list[str]]) -> dict[tuple[str, str, str], int | None]:
    """(method, options, model) of the road's solves, and how many instances each is for; None: all."""
    chosen = [parser().parse_args(command) for command in road if command[0] == "solve"]
    found = {(",".join(a.method), a.set, a.model): a.limit for a in chosen}
    assert len(found) == len(chosen)  # nothing is asked for twice
    return found


@pytest.mark.parametrize("case", GRIDS)
def test_every_command_is_understood(case: str) -> None:
    """By the parser, and by the methods whose options it sets."""
    for step in (*STEPS, "certify"):
        for command in commands(step, case, "--limit", "4", "--regime", "TO", "--workers", "2"):
            asked = parser().parse_args(command)
            assert (asked.case, str(getattr(asked, "workers", 2))) in ((case, "2"), (case, "4"))
            if command[0] in ("solve", "online"):
                (name,) = asked.method
                METHODS[name].canonical(Settings(asked.set))


def test_the_paper_s_case() -> None:
    """Every method but those for physical grids, on all instances."""
    road = commands("report")
    others = [command[0] for command in road if command[0] != "solve"]
    assert others == ["train-ko", "train-dpc", "train-dpc", "bench", "report"]
    trained = [parser().parse_args(command) for command in road if command[0] == "train-dpc"]
    assert [(a.method, a.seconds) for a in trained] == [(("ded-dpc-paper",), None), (("ded-dpc",), 420.0)]
    methods = solved(road)
    assert set(methods.values()) == {None}
    solvers, policies = {"ed", "ded", "ded-slp", "ded-ko", "ded-ko-knots"}, {"ded-dpc-paper", "ded-dpc"}
    assert {name for name, _, _ in methods} == solvers | policies


def test_physical_grids_need_no_koopman_model_and_take_slow_methods_in_small_numbers() -> None:
    """The policies of the reference run answer; nothing is trained but the paper's kind of model."""
    road = commands("report", "39bus")
    methods = solved(road)
    models = {model for name, _, model in methods if name == "ded-ko-knots"}
    assert models == {"trajectory", "linear", "koopman-paper"}
    limits = {name: limit for (name, _, _), limit in methods.items()}
    assert (limits["ded"], limits["ded-radau"], limits["ded-ko"], limits["ded-slp"]) == (10, 20, 10, None)
    assert [c for c in road if c[0].startswith("train")] == commands("train-ko", "39bus")
    few = solved(commands("report", "39bus", "--limit", "12"))
    assert {few[key] for key in few if key[0] != "ded-radau"} == {10, 12}
    timed = [c for case in ("9bus", "140bus") for c in commands("report", case) if c[0] == "bench"]
    assert [parser().parse_args(c).instances for c in timed] == [10, 2]


def test_policies_are_trained_elsewhere_if_asked() -> None:
    """On a grid of one's own, too; the words of `--train` replace the budget that stands in the file."""
    for case in ("two-area", "elsewhere/mine"):
        road = commands("report", case, "--train=--seconds 5")
        (training,) = (command for command in road if command[0] == "train-dpc")
        asked = parser().parse_args(training)
        assert (asked.method, asked.seconds) == (("ded-admm",), 5.0)
        assert "ded-admm" in {name for name, _, _ in solved(road)}
    assert "ded-admm" not in {name for name, _, _ in solved(commands("report", "elsewhere/mine"))}
    for training in commands("train-dpc", "9bus", "--train=--epochs 2")[1:]:  # after the model
        assert parser().parse_args(training).seconds is None


def test_the_first_failure_ends_it(tmp_path: Path) -> None:
    """With the exit code of the command that failed."""
    command = [sys.executable, "studies/run.py", "report", "--case", str(tmp_path / "absent")]
    made = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert made.returncode not in (0, 1)
    assert made.stdout.count("\n") == 1


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
def test_make_hands_on_what_the_user_says() -> None:
    """Its variables, and the name of the target."""
    said = ["CASE=39bus", "RESULTS=/tmp/x y", "REGIME=TO", "LIMIT=3", "TRAIN=--seconds 5", "WORKERS=3"]
    made = subprocess.run(
        ["make", "--no-print-directory", "-n", "report", *said],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    line = made.stdout.splitlines()[-1]
    words = shlex.split(line)
    assert words[1:3] == ["studies/run.py", "report"]
    given = dict(zip(words[3::2], words[4::2], strict=False))
    assert (given["--case"], given["--results"], given["--regime"]) == ("39bus", "/tmp/x y", "TO")
    assert (given["--limit"], given["--workers"], "--train=--seconds 5" in words) == ("3", "3", True)
