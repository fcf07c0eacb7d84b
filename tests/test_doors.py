"""Ways into the benchmark from outside: a package of somebody's, a function, a folder of schedules."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.cli import main
from ded_bench.problem.benchmark import load_split, write_benchmark
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.results.rows import Results
from ded_bench.results.timing import TIMING

pytestmark = pytest.mark.usefixtures("inline")
PYPROJECT = """\
[project]
name = "dispatch-flat"
version = "1.0"

[project.entry-points."ded_bench.methods"]
flat = "dispatch_flat:solve"
"""
MODULE = """\
import numpy as np
from ded_bench import Schedule


def solve(instance, regime, case):
    power = instance.p_initial(case)
    return Schedule(t=np.array([0.0, instance.horizon_s]), p=np.array([power, power]))
"""


@pytest.fixture(scope="module")
def problem(threebus: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small benchmark folder; two of its ten instances are for testing."""
    folder = tmp_path_factory.mktemp("problems") / "threebus"
    write_benchmark(threebus, 10, 7, folder)
    return folder


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the package, as an installer leaves it."""
    facts = tomllib.loads(PYPROJECT)["project"]
    site = tmp_path / "site"
    about = site / f"{facts['name'].replace('-', '_')}-{facts['version']}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {facts['name']}\nVersion: {facts['version']}\n"
    )
    lines = [
        f"[{group}]\n{name} = {value}"
        for group, p in facts["entry-points"].items()
        for name, value in p.items()
    ]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (site / "dispatch_flat.py").write_text(MODULE)
    return site


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command in this process: exit code, standard output, standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        return (code, *capsys.readouterr())

    return run


def test_a_package_of_a_few_lines_is_in_the_tables(problem, site, tmp_path, command, monkeypatch) -> None:
    """It is solved in worker processes, timed without being asked, and has its line in the report."""
    assert len((PYPROJECT + MODULE).splitlines()) <= 20
    out = tmp_path / "out"
    solve = ["solve", "--method", "flat", "--case", problem, "--workers", 2, "--out", out]
    done = subprocess.run(
        [sys.executable, "-m", "ded_bench", *map(str, solve)],
        env=os.environ | {"PYTHONPATH": f"{site}{os.pathsep}{REPOSITORY}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = list(Results(out).rows.values())
    assert [(row.method, row.status, row.workers) for row in rows] == [("flat", "Feasible", 2)] * 4
    monkeypatch.syspath_prepend(site)
    assert command("bench", "--case", problem, "--instances", 1, "--repeats", 1, "--results", out)[0] == 0
    assert command("report", "--case", problem, "--results", out)[0] == 0
    summary = pd.read_csv(out / "tables" / "summary.csv").set_index(["regime", "method"])
    for regime in ("NO", "TO"):
        assert summary.loc[(regime, "flat"), "rows"] == 2
    assert {(row.regime, row.method) for row in TIMING.existing(out / "timing.csv")} == {
        ("NO", "flat"),
        ("TO", "flat"),
    }


def test_a_function_in_the_working_directory_is_run_and_its_failures_are_rows(
    problem, tmp_path, command, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    source = MODULE.replace("    power", "    if regime == 'TO':\n        return None\n    power", 1)
    Path("own_function.py").write_text(source)
    file = problem / "instances" / f"{load_split(problem).test[0]}.json"  # the one that `bench` times
    chosen = ("--regime", "NO,TO", "--instance", file, "--out", "out")
    code, out, err = command("solve", "--method", "own_function:solve", *chosen)
    assert code == 1
    assert "own_function.solve TO, 1 time: returned nothing" in err
    rows = {row["regime"]: row for row in map(json.loads, out.splitlines())}
    assert {row["method"] for row in rows.values()} == {"own_function.solve"}
    assert rows["NO"]["status"] == "Feasible"
    assert Path(rows["NO"]["schedule"]).is_file()
    assert (rows["TO"]["status"], rows["TO"]["error"]) == (
        "Failed",
        "returned nothing, not a Schedule or a Solution",
    )
    for wrong in ("own_function:absent", "absent_module:solve", "own_function:", "/etc:solve"):
        code, out, err = command("solve", "--method", wrong, *chosen)
        assert (code, out, err.count("\n")) == (2, "", 1), err
    # Names in a results table start nobody's code: `bench` times what is registered or asked for.
    code, _, err = command("bench", "--case", problem, "--results", "out")
    assert code == 2
    assert "own_function.solve: not timed, since it has no registered name" in err
    bench = ("bench", "--case", problem, "--results", "out", "--instances", "1", "--repeats", "1")
    code, _, err = command(*bench, "--method", "own_function:solve,ed")
    assert code == 1  # its TO has nothing to time
    assert "ed: not timed, since the results hold no rows of it" in err
    times = {(row.regime, row.round): row for row in TIMING.existing(Path("out/timing.csv"))}
    assert sorted(times) == [("NO", 0), ("NO", 1), ("TO", 0), ("TO", 1)]
    assert times["NO", 1].solve_s > 0
    assert times["NO", 0].instance != times["NO", 1].instance
    assert "returned nothing" in times["TO", 1].error


def test_a_folder_of_schedules_is_a_method(problem, tmp_path, command) -> None:
    tests = [p.stem for p in sorted((problem / "instances").iterdir())]
    folder = tmp_path / "mine"
    folder.mkdir()
    for name in tests:
        (folder / f"{name}.csv").write_text("t,P_plant\n0,0.6\n6,0.6\n")
    out = tmp_path / "out"
    score = ("score", "--case", problem, "--regime", "NO,TO", "--out", out, "--schedules", folder)
    code, text, err = command(*score, "--name", "mine", "--json")
    assert code == 0
    assert len(text.splitlines()) == 4
    assert "ded-bench: 8 files of other instances: " in err
    one = json.loads(text.splitlines()[0])
    single = command(
        *("score", "--instance", problem / "instances" / f"{one['instance']}.json", "--json"),
        *("--schedule", folder / f"{one['instance']}.csv", "--regime", one["regime"]),
    )
    verdict = json.loads(single[1])
    assert {name: one[name] for name in verdict} == pytest.approx(verdict)
    (folder / f"{one['instance']}.csv").write_text("t,P_plant\n0,0.6\n5,0.6\n")
    code, _, err = command(*score, "--name", "mine")
    assert code == 1
    assert f"ded-bench: mine NO, 1 time: {folder}/{one['instance']}.csv: t: must end at the horizon" in err
    assert {row.method for row in Results(out).rows.values()} == {"mine"}
    for wrong in (
        score,  # no name
        (*score, "--name", "ded"),
        (*score[:-1], tmp_path, "--name", "mine"),
        (*score, "--schedule", folder / "a.csv", "--name", "mine"),
        ("score", "--schedule", folder / "a.csv", "--regime", "NO", "--case", problem),
    ):
        code, text, err = command(*wrong)
        assert (code, text, err.count("\n")) == (2, "", 1), err
    assert command("compare", out, out)[0] == 0
    code, text, err = command("compare", out, tmp_path)
    assert (code, text, err.count("\n")) == (2, "", 1)
