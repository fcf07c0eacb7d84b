"""The runner: resume, failures as rows, dying workers, scoring kept apart from solving."""

from __future__ import annotations

import collections
import dataclasses
import time
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.rows import ROWS, Results, Row
from ded_bench.run import runner
from ded_bench.run.environment import commit
from ded_bench.run.pool import ATTEMPTS
from ded_bench.run.runner import fallbacks, run, unfinished, unscored_row
from ded_bench.run.tasks import Task, make_tasks
from ded_bench.solvers.status import Status
from ded_bench.surrogates.linear import linear_model
from tests.strange_methods import STRANGE, solve_strange


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Register the misbehaving method here and in worker processes; returns its log."""
    log = tmp_path / "calls"
    log.touch()
    monkeypatch.setenv("STRANGE_LOG", str(log))
    monkeypatch.setitem(METHODS, "ded", STRANGE)
    monkeypatch.setattr(runner, "solve_and_score", solve_strange)
    return log


@pytest.fixture
def make(threebus: Case, quiet_instance):
    def make_these(*names: str, regimes=("NO", "TO"), settings=Settings()):  # noqa: B008
        instances = [(quiet_instance(threebus, id=name, horizon_s=0.2), "none") for name in names]
        return make_tasks(threebus, instances, ["ded"], regimes, settings)

    return make_these


def calls(log: Path) -> collections.Counter[str]:
    return collections.Counter(log.read_text().split())


def test_rows_are_scored_like_the_scorer_does(strange, make, threebus: Case, tmp_path: Path) -> None:
    tasks = make("calm-1", "calm-2")
    rows = run(threebus, tasks, Results(tmp_path / "out"), workers=2)
    assert [row.key for row in rows] == [task.key for task in tasks]
    results = Results(tmp_path / "out")
    for task, row in zip(tasks, rows, strict=True):
        schedule = results.schedule(row, threebus, task.instance)
        verdict = score(threebus, task.instance, schedule, task.regime)
        assert row.objective == pytest.approx(verdict.objective, rel=1e-12)
        assert row.feasible is True
        assert row.status == "Feasible"
        assert row.host
        assert row.version
        assert row.date.endswith("Z")


@pytest.mark.usefixtures("inline")
def test_finished_rows_are_not_made_again(strange, make, threebus: Case, tmp_path: Path) -> None:
    run(threebus, make("calm-1"), Results(tmp_path / "out"))
    before = (tmp_path / "out" / "results.csv").read_bytes()
    run(threebus, make("calm-1"), Results(tmp_path / "out"))
    assert (tmp_path / "out" / "results.csv").read_bytes() == before
    run(threebus, make("calm-1", "calm-2"), Results(tmp_path / "out"))
    assert calls(strange) == {"calm-1": 2, "calm-2": 2}  # once per regime


@pytest.mark.usefixtures("inline")
def test_a_row_says_what_it_depends_on(make, threebus: Case, quiet_instance, tmp_path: Path) -> None:
    """A limited answer is another row than an unlimited one; model, policy, commit and version are named."""
    folder, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    linear_model(threebus).save(ResultsFolder(elsewhere).model("koopman"))
    settings = Settings(search=(folder, elsewhere))
    instances = [(quiet_instance(threebus, horizon_s=0.2), "none")]

    def tasks(settings: Settings) -> list[Task]:
        return make_tasks(threebus, instances, ["ded-ko-knots"], ["NO", "TO"], settings)

    results = Results(folder)
    free = run(threebus, tasks(settings), results)
    (limited,) = run(threebus, tasks(dataclasses.replace(settings, time_limit_s=100.0))[:1], results)
    assert limited.key == free[0].key._replace(time_limit_s=100.0)
    assert limited.fingerprint != free[0].fingerprint
    assert unfinished(tasks(settings), results) == []
    assert len(results.rows) == 3
    assert limited.model == f"linear@{linear_model(threebus).fingerprint}"
    assert (limited.policy, limited.plant) == ("", "lossless")
    assert (limited.commit, limited.method_version) == (commit(), METHODS["ded-ko-knots"].version)
    path = ResultsFolder(elsewhere).model("koopman")
    assert fallbacks(tasks(settings), folder) == [
        f"ded-ko-knots {regime}: model {limited.model} from {path}" for regime in ("NO", "TO")
    ]
    assert fallbacks(tasks(settings), elsewhere) == []
    assert fallbacks(tasks(dataclasses.replace(settings, model=str(path))), folder) == []


@pytest.mark.usefixtures("inline")
def test_a_row_of_an_older_version_is_made_anew(strange, make, threebus: Case, tmp_path: Path) -> None:
    """Other code without a new version makes no row invalid."""
    results = Results(tmp_path / "out")
    rows = run(threebus, make("calm-1"), results)
    results.add([dataclasses.replace(row, commit="0000000", version="0.0.1") for row in rows])
    run(threebus, make("calm-1"), results)
    assert calls(strange) == {"calm-1": 2}
    results.add([dataclasses.replace(row, method_version=row.method_version - 1) for row in rows])
    again = run(threebus, make("calm-1"), results)
    assert calls(strange) == {"calm-1": 4}
    assert {row.method_version for row in again} == {row.method_version for row in rows}


@pytest.mark.usefixtures("inline")
def test_a_run_leaves_one_line_per_row_even_if_interrupted(
    strange, make, threebus: Case, tmp_path: Path
) -> None:
    """What was solved before the interruption is not solved again."""
    results = Results(tmp_path / "out")

    def interrupt(row: Row) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(threebus, make("calm-1"), results, on_row=interrupt)
    (done,) = ROWS.read(results.path)
    assert done.objective is not None
    (left,) = unfinished(make("calm-1"), Results(tmp_path / "out"))
    assert left.key != done.key
    run(threebus, make("calm-1"), results)
    assert len(results.path.read_text().splitlines()) == 3
    assert results.rows[done.key] == done


def test_failures_are_rows_and_the_run_goes_on(strange, make, threebus: Case, tmp_path: Path) -> None:
    tasks = make("raise-1", "crash-1", "calm-1", "apart-1", regimes=["NO"])
    rows = run(threebus, tasks, Results(tmp_path / "out"), workers=2)
    by_name = {row.instance: row for row in rows}
    assert by_name["raise-1"].status == "Failed"
    assert by_name["raise-1"].error.startswith("ValueError: no idea how (strange_methods.py, line ")
    log = (tmp_path / "out" / "failures.log").read_text()
    assert log.startswith("ded NO raise-1\nTraceback (most recent call last)")
    assert by_name["crash-1"].status == "Failed"
    assert f"died {ATTEMPTS} times" in by_name["crash-1"].error
    assert by_name["calm-1"].objective is not None
    assert by_name["apart-1"].status == "Feasible"  # the claim stays, the verdict is separate
    assert by_name["apart-1"].feasible is not True
    assert len(rows) == 4


def test_a_worker_that_dies_once_costs_nothing(strange, make, threebus: Case, tmp_path: Path) -> None:
    rows = run(threebus, make("once-1", "calm-1"), Results(tmp_path / "out"), workers=2)
    assert [row.objective is not None for row in rows] == [True] * 4
    assert len({row.key for row in rows}) == 4


@pytest.mark.usefixtures("inline")
def test_nonsense_is_a_row_that_can_be_read(strange, make, threebus: Case, tmp_path: Path) -> None:
    run(threebus, make("wrong", "huge", regimes=["NO"]), Results(tmp_path / "out"))
    rows = {row.instance: row for row in Results(tmp_path / "out").rows.values()}
    assert (rows["wrong"].status, rows["wrong"].objective) == ("Failed", None)
    assert "type int, not a Schedule or a Solution" in rows["wrong"].error
    assert (rows["huge"].solver_objective, rows["huge"].error, rows["huge"].iterations) == (None, "a b", 3)


def test_a_hang_is_a_time_limit_and_blames_nobody_else(
    strange, make, threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "GRACE_S", 4.0)
    tasks = make("hang", "slow-1", "slow-2", "slow-3", regimes=["NO"], settings=Settings(time_limit_s=1.0))
    started = time.monotonic()
    rows = {row.instance: row for row in run(threebus, tasks, Results(tmp_path / "out"), workers=2)}
    assert time.monotonic() - started < 60.0
    assert rows.pop("hang").status == "TimeLimit"
    assert Results(tmp_path / "out").rows[tasks[0].key].error.startswith("no answer after 5 s")
    assert {row.status for row in rows.values()} == {"Feasible"}
    assert calls(strange) == {"hang": 1, "slow-1": 1, "slow-2": 1, "slow-3": 1}


@pytest.mark.usefixtures("inline")
def test_a_failure_takes_an_earlier_schedule_away(
    strange, make, threebus: Case, constant, tmp_path: Path
) -> None:
    """Else it would be taken for the failed row's own."""
    results = Results(tmp_path / "out")
    (task,) = make("raise", regimes=["NO"])
    power = task.instance.p_initial(threebus)
    earlier = unscored_row(task, Solution(Status.FEASIBLE), "lossless", 1, "", "here")
    earlier = dataclasses.replace(earlier, method_version=0)
    results.keep(earlier, constant(task.instance, power), threebus)
    (row,) = run(threebus, [task], results)
    assert not results.has_schedule(row)


def test_wrong_choices_name_the_known_ones(threebus: Case, quiet_instance) -> None:
    instances = [(quiet_instance(threebus), "none")]
    with pytest.raises(InputError, match=r"unknown method.*ded-ko"):
        make_tasks(threebus, instances, ["magic"], ["NO"], Settings())
    with pytest.raises(InputError, match="unknown regime"):
        make_tasks(threebus, instances, ["ded"], ["XX"], Settings())
    with pytest.raises(InputError, match=r"magic: no such option"):
        make_tasks(threebus, instances, ["ded"], ["NO"], Settings("magic=1"))
