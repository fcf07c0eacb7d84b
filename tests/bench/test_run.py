"""The runner: resume, failures as rows, dying workers, scoring kept apart from solving."""

from __future__ import annotations

import collections
import time
from pathlib import Path

import pytest

from ded_bench.bench.results import Results
from ded_bench.bench.run import ATTEMPTS, Workers, make_tasks, run
from ded_bench.methods import METHODS, Method
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.errors import InputError
from ded_bench.truth.score import score


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Register the misbehaving method here and in worker processes; returns its log."""
    log = tmp_path / "calls"
    log.touch()
    monkeypatch.setenv("STRANGE_LOG", str(log))
    monkeypatch.setitem(METHODS, "ded", Method("ded", "tests.bench.strange_methods", "strange"))
    return log


@pytest.fixture
def make(threebus: Case, quiet_instance):
    def make_these(*names: str):
        instances = [(quiet_instance(threebus, id=name, horizon_s=0.2), "none") for name in names]
        return make_tasks(threebus, instances, ["ded"], ["NO", "TO"], Settings())

    return make_these


def calls(log: Path) -> collections.Counter[str]:
    return collections.Counter(log.read_text().split())


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Worker processes import afresh: tell them, too, where the strange method is."""
    if "strange" in request.fixturenames:
        import ded_bench.bench.run as module

        monkeypatch.setattr(module, "solve_task", _solve_strange)


def _solve_strange(case, task):
    from ded_bench.bench.run import solve_task

    METHODS["ded"] = Method("ded", "tests.bench.strange_methods", "strange")
    return solve_task(case, task)


def test_rows_are_scored_like_the_scorer_does(strange, make, threebus: Case, tmp_path: Path) -> None:
    tasks = make("calm-1", "calm-2")
    rows = run(threebus, tasks, Results(tmp_path / "out"), workers=2)
    assert [row.key for row in rows] == [task.key for task in tasks]
    results = Results(tmp_path / "out")
    for task, row in zip(tasks, rows, strict=True):
        verdict = score(
            threebus, task.instance, results.schedule(task.key, threebus, task.instance), task.regime
        )
        assert row.objective == pytest.approx(verdict.objective, rel=1e-12)
        assert row.feasible is True
        assert row.status == "Feasible"
        assert row.host
        assert row.version
        assert row.date.endswith("Z")


def test_finished_rows_are_not_made_again(strange, make, threebus: Case, tmp_path: Path) -> None:
    run(threebus, make("calm-1"), Results(tmp_path / "out"))
    before = (tmp_path / "out" / "results.csv").read_bytes()
    run(threebus, make("calm-1"), Results(tmp_path / "out"))
    assert (tmp_path / "out" / "results.csv").read_bytes() == before
    run(threebus, make("calm-1", "calm-2"), Results(tmp_path / "out"))
    assert calls(strange) == {"calm-1": 2, "calm-2": 2}  # once per regime


def test_a_schedule_without_its_score_is_only_scored(strange, make, threebus: Case, tmp_path: Path) -> None:
    import dataclasses

    results = Results(tmp_path / "out")
    rows = run(threebus, make("calm-1"), results)
    results.add([dataclasses.replace(row, objective=None, feasible=None) for row in rows])
    assert run(threebus, make("calm-1"), Results(tmp_path / "out")) == rows
    assert calls(strange) == {"calm-1": 2}


def test_failures_are_rows_and_the_run_goes_on(strange, make, threebus: Case, tmp_path: Path) -> None:
    rows = run(
        threebus, make("raise-1", "crash-1", "calm-1", "apart-1"), Results(tmp_path / "out"), workers=2
    )
    by_name = {row.instance: row for row in rows}
    assert by_name["raise-1"].status == "Failed"
    assert by_name["raise-1"].error == "ValueError: no idea how"
    assert by_name["crash-1"].status == "Failed"
    assert f"died {ATTEMPTS} times" in by_name["crash-1"].error
    assert by_name["calm-1"].objective is not None
    assert by_name["apart-1"].status == "Feasible"  # the claim stays, the verdict is separate
    assert by_name["apart-1"].feasible is not True
    assert len(rows) == 8


def test_a_worker_that_dies_once_costs_nothing(strange, make, threebus: Case, tmp_path: Path) -> None:
    rows = run(threebus, make("once-1", "calm-1"), Results(tmp_path / "out"), workers=2)
    assert [row.objective is not None for row in rows] == [True] * 4
    assert len({row.key for row in rows}) == 4


def test_a_worker_that_dies_between_two_submissions_costs_nothing() -> None:
    with Workers(1) as pool:
        answers = pool.imap([(abs, (-i,)) for i in range(5)], range(5))
        first = next(answers)
        assert pool._pool is not None
        for process in pool._pool._processes.values():
            process.kill()
        deadline = time.monotonic() + 30
        while not pool._pool._broken:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert sorted([first, *answers]) == [(i, i) for i in range(5)]


def test_wrong_choices_name_the_known_ones(threebus: Case, quiet_instance) -> None:
    instances = [(quiet_instance(threebus), "none")]
    with pytest.raises(InputError, match=r"unknown method.*ded-ko"):
        make_tasks(threebus, instances, ["magic"], ["NO"], Settings())
    with pytest.raises(InputError, match="unknown regime"):
        make_tasks(threebus, instances, ["ded"], ["XX"], Settings())
    with pytest.raises(InputError, match=r"magic: unknown to method ded \(known: default"):
        make_tasks(threebus, instances, ["ded"], ["NO"], Settings(name="magic"))
