"""Rows solved again: what is found, what differs, what cannot be compared."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from ded_bench.analysis.compare import reproduce
from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.results.rows import Results, Row
from ded_bench.run.runner import run
from ded_bench.run.tasks import make_tasks

pytestmark = pytest.mark.usefixtures("inline")


def test_differences_are_told_and_limits_named(threebus: Case, quiet_instance, tmp_path: Path) -> None:
    instances = {name: quiet_instance(threebus, id=name, horizon_s=0.2) for name in "abcd"}
    results = Results(tmp_path)
    chosen = [(instance, "test") for instance in instances.values()]
    a, b, c, d = run(threebus, make_tasks(threebus, chosen, ["ed"], ["TO"], Settings()), results)
    dearer = dataclasses.replace(b, objective=b.objective * (1 + 2e-6))
    rounded = dataclasses.replace(c, objective=c.objective * (1 + 1e-7))
    results.add([dearer, rounded, dataclasses.replace(d, status="TimeLimit")])
    results.add([dataclasses.replace(a, method="mine"), dataclasses.replace(a, policy="ed@f00")])
    before = results.path.read_bytes()
    said: list[str] = []
    found = reproduce(threebus, instances, results, sample=9, tell=said.append)
    ours, theirs = found.to_dict("records")
    assert (ours["method"], ours["rows"], ours["differ"]) == ("ed", 3, 1)
    assert (ours["objective"], ours["Hz"]) == (pytest.approx(2e-6, rel=1e-3), 0.0)
    (different,) = (sentence for sentence in said if "now" in sentence)
    assert different.startswith("ed default TO: b: objective ")
    assert [s for s in said if "ended by a limit (d)" in s]
    assert [s for s in said if "its ed@f00 is not the one in" in s]
    assert (theirs["method"], theirs["rows"], theirs["differ"]) == ("mine", 0, 0)
    assert "mine default TO: a: no method has this name" in said
    assert results.path.read_bytes() == before


def test_own_methods_are_solved_again(threebus: Case, quiet_instance, tmp_path: Path, monkeypatch) -> None:
    """Named in either way."""
    text = "from ded_bench import Schedule\n"
    text += "def solve(instance, regime, case):\n    p = instance.p_initial(case)\n"
    text += "    return Schedule([0.0, instance.horizon_s], [p, p])\n"
    (tmp_path / "again_of_mine.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    instance, results = quiet_instance(threebus, id="a", horizon_s=0.2), Results(tmp_path / "out")
    tasks = make_tasks(threebus, [(instance, "test")], ["again_of_mine:solve"], ["TO"], Settings())
    run(threebus, tasks, results)
    found = reproduce(threebus, {"a": instance}, results, ["again_of_mine.solve"])
    assert found[["method", "rows", "differ"]].to_numpy().tolist() == [["again_of_mine.solve", 1, 0]]


def test_what_compares_nothing_shows_nothing(tmp_path: Path) -> None:
    row = Row("9bus-0003", "test", "TO", "mine", "default", "Feasible", case="9bus", fingerprint="f")
    Results(tmp_path).add([row])
    assert main(["reproduce", "--results", str(tmp_path)]) == 1


def test_the_sample_is_the_same_every_time(threebus: Case, quiet_instance, tmp_path: Path) -> None:
    instances = {f"i{n}": quiet_instance(threebus, id=f"i{n}", horizon_s=0.2) for n in range(6)}
    results = Results(tmp_path)
    chosen = [(instance, "test") for instance in instances.values()]
    rows = run(threebus, make_tasks(threebus, chosen, ["ed"], ["TO"], Settings()), results)
    results.add([dataclasses.replace(row, objective=2.0 * row.objective) for row in rows])
    said: tuple[list[str], list[str]] = [], []
    for sentences in said:
        reproduce(threebus, instances, results, ["ed"], 2, tell=sentences.append)
    assert said[0] == said[1]
    assert len(said[0]) == 2
    with pytest.raises(InputError, match="has no rows of nobody"):
        reproduce(threebus, instances, results, ["nobody"])
