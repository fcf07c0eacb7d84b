"""The road of every grid: what `make report` and its relatives run, as `studies/run.py --list` says."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import shlex
import subprocess
import types
from pathlib import Path

import pytest

from ded_bench.cli import commands as cli
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import REPOSITORY

STEPS = ("train-ko", "solve-baselines", "train-dpc", "solve-dpc", "bench", "report", "online", "radau")
STEPS += ("models", "certify")
PARSER = functools.cache(cli.parser)
GRIDS = ("9bus", "two-area", "39bus", "68bus", "140bus", "39bus-agc", "elsewhere/mine")


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where `make` runs."""
    monkeypatch.chdir(REPOSITORY)


def run(*arguments: str) -> tuple[int, list[list[str]]]:
    """Exit code of the script, and the commands that it printed, without the program's name."""
    spec = importlib.util.spec_from_file_location("run", REPOSITORY / "studies" / "run.py")
    assert spec is not None
    assert spec.loader is not None
    script, printed = importlib.util.module_from_spec(spec), io.StringIO()
    spec.loader.exec_module(script)
    with contextlib.redirect_stdout(printed):
        code = script.main(list(arguments))
    return code, [shlex.split(line)[1:] for line in printed.getvalue().splitlines()]


def commands(step: str, case: str = "9bus", *arguments: str) -> list[list[str]]:
    """The commands of a step."""
    code, found = run(step, "--case", case, "--list", *arguments)
    assert code == 0
    return found


def solved(road: list[list[str]]) -> dict[tuple[str, str, str], int | None]:
    """(method, options, model) of the road's solves, and how many instances each is for; None: all."""
    chosen = [PARSER().parse_args(command) for command in road if command[0] == "solve"]
    found = {(",".join(a.method), a.set, a.model): a.limit for a in chosen}
    assert len(found) == len(chosen)  # nothing is asked for twice
    return found


def test_it_says_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: types.SimpleNamespace(returncode=0))
    road = commands("report", "9bus", "--runs", "quick")
    _, found = run("report", "--runs", "quick")
    assert [line[1] for line in found] == [f"{len(road)}]"] * len(road)  # after "[1 of "


@pytest.mark.parametrize("case", GRIDS)
def test_every_command_is_understood(case: str) -> None:
    """By the parser, and by the methods whose options it sets."""
    for step in STEPS:
        for command in commands(step, case, "--limit", "4", "--regime", "TO", "--workers", "2"):
            asked = PARSER().parse_args(command)
            assert (asked.case, str(getattr(asked, "workers", None) or 2)) in ((case, "2"), (case, "4"))
            if command[0] in ("solve", "online"):
                (name,) = asked.method
                METHODS[name].canonical(Settings(asked.set))


def test_methods_that_refuse_islands_are_not_on_their_road() -> None:
    methods = {name for name, _, _ in solved(commands("report", "two-area-agc"))}
    assert methods == {"ed", "ded-slp", "ded-rti", "ded-ko-knots", "ded-admm"}


def test_the_smaller_limit_counts() -> None:
    """A file's own for slow methods, or the user's."""
    assert set(solved(commands("report")).values()) == {None}
    few = solved(commands("report", "39bus", "--limit", "12"))
    assert set(few.values()) == {10, 12}
    assert {name for (name, _, _), limit in few.items() if limit == 10} == {"ded", "ded-ko"}


def test_policies_are_trained_elsewhere_if_asked() -> None:
    """On a grid of one's own, too; the words of `--train` replace the budget that stands in the file."""
    for case in ("two-area", "elsewhere/mine"):
        road = commands("report", case, "--train=--seconds 5")
        (training,) = (command for command in road if command[0] == "train-dpc")
        asked = PARSER().parse_args(training)
        assert (asked.method, asked.seconds) == (("ded-admm",), 5.0)
        assert "ded-admm" in {name for name, _, _ in solved(road)}
    assert "ded-admm" not in {name for name, _, _ in solved(commands("report", "elsewhere/mine"))}
    for training in commands("train-dpc", "9bus", "--train=--epochs 2")[1:]:  # after the model
        assert PARSER().parse_args(training).seconds is None


def test_the_first_failure_ends_it(tmp_path: Path) -> None:
    """With the exit code of the command that failed."""
    code, started = run("report", "--case", str(tmp_path / "absent"))
    assert code not in (0, 1)
    assert len(started) == 1
