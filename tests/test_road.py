"""The Makefile's road: what `make report` and its relatives would run on each case."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from ded_bench.cli.commands import parser
from ded_bench.methods.registry import METHODS

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="needs make")


def commands(*arguments: str) -> list[list[str]]:
    """The `ded-bench` commands that make would run, without the program's name."""
    made = subprocess.run(["make", "-n", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    lines = made.stdout.replace("\\\n", " ").splitlines()
    return [shlex.split(line)[1:] for line in lines if line.startswith(".venv/bin/ded-bench ")]


def solved(road: list[list[str]]) -> dict[tuple[str, str, str], int | None]:
    """(method, settings, model) of the road's solves, and how many instances each is for; None: all."""
    chosen = [parser().parse_args(command) for command in road if command[0] == "solve"]
    found = {(",".join(a.method), a.settings, a.model): a.limit for a in chosen}
    assert len(found) == len(chosen)  # nothing is asked for twice
    return found


def test_the_paper_s_case() -> None:
    road = commands("report")
    assert [command[0] for command in road if command[0] != "solve"] == [
        *("train-ko", "train-dpc", "train-dpc", "bench", "report")
    ]
    trained = [parser().parse_args(command) for command in road if command[0] == "train-dpc"]
    assert [(a.method, a.seconds) for a in trained] == [(("ded-dpc-paper",), None), (("ded-dpc",), 420.0)]
    methods = solved(road)
    assert set(methods.values()) == {None}
    elsewhere = {"ded-radau", "ded-dpc-shared", "ded-dpc-shared-refined"}
    assert {name for name, _, _ in methods} == set(METHODS) - elsewhere
    assert {("ded", "accelerated", "koopman"), ("ed", "*", "koopman")} <= set(methods)


def test_a_physical_grid_is_solved_on_every_model_and_by_euler_on_a_few_instances() -> None:
    road = commands("report", "CASE=39bus")
    methods = solved(road)
    knots = {model for name, _, model in methods if name == "ded-ko-knots"}
    assert knots == {"koopman", "linear", "koopman-paper", "trajectory"}
    assert methods["ded", "default", "koopman"] == 10
    assert methods["ded-radau", "default", "koopman"] == 20
    assert methods["ded-slp", "default", "koopman"] is None
    assert [c[c.index("--case") + 1] for c in road] == ["39bus"] * len(road)
    assert "train-dpc" not in {command[0] for command in road}


def test_policies_are_trained_elsewhere_if_asked() -> None:
    road = commands("report", "CASE=two-area", "TRAIN=--seconds 5")
    (training,) = (command for command in road if command[0] == "train-dpc")
    asked = parser().parse_args(training)
    assert (asked.case, asked.method, asked.seconds) == ("two-area", ("ded-dpc-shared",), 5.0)
    assert {("ded-dpc-shared", "default", "koopman"), ("ded-dpc-shared-refined", "*", "koopman")} <= set(
        solved(road)
    )
    assert not {"ded-dpc", "ded-dpc-refined"} & {name for name, _, _ in solved(road)}


def test_limits_of_slow_methods_and_of_the_user() -> None:
    assert set(solved(commands("report", "CASE=39bus", "LIMIT=4")).values()) == {4}
    few = solved(commands("report", "CASE=140bus", "LIMIT=8", "LIMIT_ded-radau_140bus=2"))
    assert few["ded-radau", "default", "koopman"] == 2
    assert few["ded-slp", "default", "koopman"] == 8
    assert ("ded", "default", "koopman") not in few


def test_a_folder_of_one_s_own(tmp_path: Path) -> None:
    methods = solved(commands("report", f"CASE={tmp_path}", f"RESULTS={tmp_path}/results"))
    assert {name for name, _, _ in methods} == {"ed", "ded-radau", "ded-slp", "ded-ko", "ded-ko-knots"}


def test_every_command_is_understood() -> None:
    for target in ("report", "models", "ablation", "certify", "radau", "starts", "quick", "ac"):
        for command in commands(target):
            parser().parse_args(command)


def test_certificates_are_of_the_policy_that_the_road_trains() -> None:
    for case, method in (("9bus", "ded-dpc"), ("39bus", "ded-dpc-shared")):
        made = commands("certify", f"CASE={case}")
        (command,) = (c for c in made if c[0] == "certify")
        assert parser().parse_args(command).method == method
        trained = [parser().parse_args(c).method for c in made if c[0] == "train-dpc"]
        assert (method,) in trained


def test_fewer_instances_are_timed_on_large_grids() -> None:
    timed = {}
    for case in ("9bus", "140bus"):
        (command,) = (c for c in commands("report", f"CASE={case}") if c[0] == "bench")
        timed[case] = parser().parse_args(command).instances
    assert 0 < timed["140bus"] < timed["9bus"] == 10
