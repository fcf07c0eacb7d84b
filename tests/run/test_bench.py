"""Times of methods alone on the machine: what is measured, what is kept, and the table it is kept in."""

from __future__ import annotations

import dataclasses
import gc
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.options import option
from ded_bench.methods.registry import METHODS, Method, registered
from ded_bench.methods.solution import Artifact, Settings, Solution
from ded_bench.problem.benchmark import validation_instances
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key, Row
from ded_bench.results.timing import TIMING, TimingRow, timing_summary
from ded_bench.run import bench as bench_module
from ded_bench.run import environment
from ded_bench.run.bench import ROUNDS, Job, bench, rounds_of, runs_of, timed
from ded_bench.run.pool import WorkerDiedError, Workers
from ded_bench.run.runner import GRACE_S
from ded_bench.run.tasks import prepared
from ded_bench.solvers.status import Status
from tests.conftest import answers_here

ROW = TimingRow("run", 1, "TO", "ded", "default", "a", "Optimal", build_s=0.5, solve_s=3.5, host="here")
TO = Job("fake", "TO", Settings())
BOTH = [Job("fake", "NO", Settings()), TO]


@dataclasses.dataclass(frozen=True)
class Choices:
    """Options of the fake method."""

    fast: bool = option(False, "quick and dirty")


class Inline(Workers):
    """Calls are made in this process, so that a method of this test is found."""

    imap = answers_here

    def __init__(self, count: int) -> None:
        assert count == 1  # anything more would not be alone
        super().__init__(count)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.ModuleType]:
    """A registered method `fake` that answers with `module.times` in turn; its artifact can change."""
    module = types.ModuleType("fake_method")
    module.Options, module.VERSION = Choices, 4
    module.calls = []
    module.times = [0.5]
    module.artifact_name = "one"
    module.artifacts = lambda case, regime, settings: (Artifact("policy", "fake", module.artifact_name),)

    def prepare(case: Case, regime: str, settings: Settings) -> Callable[[Instance], Solution]:
        def solve(instance: Instance) -> Solution:
            seconds = module.times[len(module.calls) % len(module.times)]
            module.calls.append(instance.id)
            if isinstance(seconds, BaseException):
                raise seconds
            if seconds == "none":
                return Solution(Status.INFEASIBLE, error="no way")
            schedule = Schedule(instance.grid[[0, -1]], 0 * instance.p_initial(case)[None].repeat(2, 0))
            return Solution(Status.OPTIMAL, schedule, build_s=0.1, setup_s=None, solve_s=seconds)

        return solve

    module.prepare = prepare
    monkeypatch.setitem(sys.modules, "fake_method", module)
    monkeypatch.setitem(METHODS, "fake", Method("fake", "fake_method", "Fake"))
    monkeypatch.setattr(bench_module, "Workers", Inline)
    prepared.cache_clear()
    yield module
    prepared.cache_clear()


@pytest.fixture
def instances(threebus: Case) -> list[Instance]:
    return [sample_instance(threebus, 1, i) for i in range(3)]


@pytest.fixture
def run(fake, threebus: Case, instances: list[Instance], tmp_path: Path) -> Callable[..., list[TimingRow]]:
    """`run(jobs, rounds=1, ...)`: bench of the fake method on three instances."""
    warm_up = validation_instances(threebus, 1)[0]

    def bench_fake(jobs: list[Job], **options: object) -> list[TimingRow]:
        arguments = {"rounds": 1, "warm_up": warm_up} | options
        return bench(threebus, instances, jobs, tmp_path / "timing.csv", **arguments)

    return bench_fake


def test_every_turn_begins_with_another_instance(fake, run, instances) -> None:
    fake.times = [100.0, 1.0, 2.0, 3.0, 50.0, 4.0, 5.0, 6.0]
    rows = run([TO], rounds=2)
    assert fake.calls == 2 * ["threebus-v0000", *(i.id for i in instances)]
    assert [row.round for row in rows] == [0, 1, 1, 1, 2, 2, 2]  # only the process's first call is a row
    assert [row.solve_s for row in rows] == [100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    summary = timing_summary(rows).iloc[0]
    assert summary["solve_s"] == 3.5
    with pytest.raises(InputError, match="warms up"):
        run([TO], warm_up=instances[0])


def test_methods_take_turns_in_an_order_that_rotates(fake, run, instances) -> None:
    rows = [row for row in run(BOTH, rounds=2) if row.round]
    assert [row.round for row in rows] == [1] * 6 + [2] * 6
    assert [row.instance for row in rows] == [i.id for i in instances] * 4  # a turn: all instances in a row
    assert [row.regime for row in rows[::3]] == ["NO", "TO", "TO", "NO"]


def test_garbage_is_not_collected_while_a_call_is_timed(fake, threebus, instances) -> None:
    seen = []
    calls = [
        timed(lambda instance: seen.append(gc.isenabled()) or Solution(Status.OPTIMAL), instances[0]),
        timed(lambda instance: 1 / 0, instances[0]),
    ]
    assert seen == [False]
    assert gc.isenabled()  # also after a failure
    assert "ZeroDivisionError" in calls[1]["error"]


def test_only_the_instance_that_kills_its_process_is_lost(fake, run, instances, monkeypatch) -> None:
    class Fragile(Inline):
        def imap(self, calls, labels, limits_s) -> Iterator[tuple[object, object]]:
            ((function, arguments),) = calls
            if instances[1] in arguments[-1]:
                yield None, WorkerDiedError("died")
            else:
                yield from super().imap([(function, arguments)], labels)

    monkeypatch.setattr(bench_module, "Workers", Fragile)
    rows = run([TO])
    assert [row.error for row in rows] == ["", "", "died", ""]
    assert [row.instance for row in rows[1:]] == [i.id for i in instances]


def test_a_hang_is_killed_where_calls_have_a_time_limit(fake, run, instances, monkeypatch) -> None:
    """A turn may take the limits of all its calls, the warm-up's included."""
    given = []

    class Noting(Inline):
        def imap(self, calls, labels, limits_s) -> Iterator[tuple[object, object]]:
            given.extend(limits_s)
            yield from super().imap(calls, labels)

    monkeypatch.setattr(bench_module, "Workers", Noting)
    run([TO, Job("fake", "NO", Settings(time_limit_s=2.0))])
    assert given == [None, (1 + len(instances)) * (2.0 + GRACE_S)]


def test_median_and_quartiles_over_instances_and_rounds(fake, run) -> None:
    fake.times = [9.0, 1.0, 2.0, 3.0, 9.0, 4.0, 5.0, 6.0]
    summary = timing_summary(run([TO], rounds=2))
    (row,) = summary.to_dict("records")
    assert (row["solve_s_q1"], row["solve_s"], row["solve_s_q3"]) == (2.25, 3.5, 4.75)
    assert (row["instances"], row["repeats"], row["failures"]) == (3, 2, 0)
    assert row["build_s"] == 0.1
    assert np.isnan(row["setup_s"])  # the method does not tell: not available, not zero
    assert row["load_average"] >= 0
    assert 20 < row["peak_memory_mib"] < 10_000  # Python and NumPy alone take some
    assert (row["policy"], row["model"]) == ("fake@one", "")
    assert not len(timing_summary([]))


@pytest.mark.parametrize(
    ("seconds", "rounds"), [([2.0, 3.0], 1), ([2.0, 2.9], 2), ([0.5, 0.6], 5), ([0.1, 0.1], 10), ([0.0], 10)]
)
def test_rounds_come_to_five_seconds_or_to_the_most(seconds: list[float], rounds: int) -> None:
    assert rounds_of(dataclasses.replace(ROW, call_s=s) for s in seconds) == rounds
    assert rounds_of([dataclasses.replace(ROW, error="failed")]) == 1


def test_fast_methods_take_part_in_more_rounds(fake, run) -> None:
    assert max(row.round for row in run([TO], rounds=None)) == ROUNDS[-1]
    fake.times = ["none"]
    assert max(row.round for row in run([TO], rounds=None, force=True)) == 1  # failures are not repeated


def test_failed_calls_are_counted_and_enter_no_median(fake, run) -> None:
    fake.times = [1.0, 1.0, "none", 3.0]
    row = timing_summary(run([TO])).iloc[0]
    assert (row["failures"], row["solve_s"], row["error"]) == (1, 2.0, "")


def test_a_complete_run_is_not_repeated(fake, run, tmp_path: Path) -> None:
    first = run(BOTH)
    assert TIMING.existing(tmp_path / "timing.csv") == first
    fake.calls.clear()
    assert run(BOTH) == first
    assert not fake.calls
    run(BOTH, force=True)
    assert len(fake.calls) == 2 * 4
    fake.artifact_name = "another policy"
    again = run(BOTH)
    assert len(fake.calls) == 4 * 4
    assert {row.run for row in again}.isdisjoint(row.run for row in first)
    assert TIMING.existing(tmp_path / "timing.csv") == again  # replaced as a whole


def test_a_run_of_some_methods_does_not_replace_one_of_more(fake, run, tmp_path: Path) -> None:
    run(BOTH)
    before = (tmp_path / "timing.csv").read_bytes()
    with pytest.raises(InputError, match="fake in NO"):
        run([TO])
    assert (tmp_path / "timing.csv").read_bytes() == before
    run([*BOTH, Job("fake", "TO", Settings("fast=on"))])  # more methods: all are timed anew
    assert len(timing_summary(TIMING.existing(tmp_path / "timing.csv"))) == 3


def test_an_interrupted_run_goes_on(fake, run, tmp_path: Path) -> None:
    """What was timed is kept beside the table, which stays as it was until the run is complete."""
    fake.times = [1.0] * 6 + [KeyboardInterrupt()]  # in the second method's turn
    with pytest.raises(KeyboardInterrupt):
        run(BOTH)
    assert not (tmp_path / "timing.csv").exists()
    assert len(TIMING.existing(tmp_path / "timing.partial.csv")) == 4  # the turn that was complete
    fake.times = [2.0]
    prepared.cache_clear()
    rows = run(BOTH)
    assert [row.solve_s for row in rows] == [1.0] * 4 + [2.0] * 4
    assert len({row.key for row in rows}) == len(rows) == 8
    assert [path.name for path in tmp_path.iterdir()] == ["timing.csv"]


@pytest.mark.parametrize(
    "job", [("nope", "TO", "default"), ("fake", "XX", "default"), ("fake", "TO", "nope=1")]
)
def test_bad_input(fake, run, threebus, tmp_path, job) -> None:
    with pytest.raises(InputError):
        run([Job(job[0], job[1], Settings(job[2]))])
    with pytest.raises(InputError, match="at least one"):
        run([])


def test_full_ded_in_a_process_of_its_own(threebus: Case, tmp_path: Path) -> None:
    """The real thing: build and set-up of the first call cost more than those of the timed ones."""
    instance, warm_up = (
        sample_instance(threebus, 1, i).model_copy(update={"horizon_s": 1.0}) for i in range(2)
    )
    rows = bench(
        threebus,
        [instance],
        [Job("ded", "TO", Settings())],
        tmp_path / "timing.csv",
        warm_up=warm_up,
        rounds=2,
        problems_version="v",
    )
    assert rows == TIMING.existing(tmp_path / "timing.csv")
    (row,) = timing_summary(rows).to_dict("records")
    assert (row["failures"], row["error"], row["repeats"], row["problems_version"]) == (0, "", 2, "v")
    assert 0 < row["solve_s"] < 30
    assert rows[0].round == 0
    assert rows[0].build_s > row["build_s"]
    assert "ipopt" in row["solver_version"]
    assert all(row.call_s > row.solve_s for row in rows)


def test_runs_of_a_results_table(fake, tmp_path: Path) -> None:
    """Settings and limits of the time come back from the rows; what is unknown today does not."""
    rows = {
        Key("c", "a", "TO", "fake", "default", time_limit_s=9.0),
        Key("c", "b", "TO", "fake", "default", time_limit_s=20.0),
        Key("c", "b", "NO", "fake", "default"),
        Key("c", "c", "NO", "fake", "default", time_limit_s=9.0),
        Key("c", "a", "TO", "fake", "fast=on", "linear@f00"),
        Key("c", "a", "TO", "fake", "default", "myfile@f00"),
        Key("c", "a", "TO", "fake", "of=old"),
        Key("c", "a", "TO", "stranger", "default"),
    }
    made = [Row(split="test", status="Optimal", **key._asdict()) for key in rows]
    assert runs_of(made, Settings(search=(tmp_path,)), registered()) == [
        Job("fake", "NO", Settings(search=(tmp_path,))),
        Job("fake", "TO", Settings(time_limit_s=20.0, search=(tmp_path,))),
        Job("fake", "TO", Settings("fast=on", "linear", search=(tmp_path,))),
    ]


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ("model name\t: Some CPU\nflags\t\t: fpu avx2 avx512f\n", "Some CPU AVX-512"),
        ("model name\t: Some CPU\nflags\t\t: fpu avx2\n", "Some CPU AVX2"),
        ("model name\t: Some CPU\nflags\t\t: fpu\n", "Some CPU"),
        ("", "unknown processor"),
    ],
)
def test_a_host_is_told_with_its_vectors(facts: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processors of one name may differ in them, and then in times."""
    monkeypatch.setattr(environment.Path, "read_text", lambda self: facts)
    monkeypatch.setattr(environment.platform, "processor", lambda: "")
    assert environment.host.__wrapped__().startswith(f"{said}, ")
