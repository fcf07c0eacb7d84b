"""Timing alone on the machine: what is measured, what is kept, and the file it is kept in."""

from __future__ import annotations

import dataclasses
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from ded_bench.evaluate import timing
from ded_bench.evaluate.timing import (
    COLUMNS,
    MAX_REPEATS,
    TimingRow,
    bench_folder,
    bench_methods,
    choose_sample,
    format_timing,
    latest_host,
    measure,
    read_timing,
    runs_of,
    timing_frame,
)
from ded_bench.files.errors import InputError
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.registry import METHODS, Method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.results import Key
from ded_bench.solvers.status import Status

ROW = TimingRow(
    "TO",
    "ded",
    "default",
    10,
    1,
    0,
    3.5,
    3.25,
    4.0,
    host="here",
    date="2026-01-01T00:00:00Z",
    fingerprint="x",
)


class Inline:
    """Stands for `Workers`: runs calls in this process, so that a method of this test is found."""

    def __init__(self, count: int) -> None:
        assert count == 1  # anything more would not be alone

    def __enter__(self) -> Inline:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def imap(self, calls, labels) -> Iterator[tuple[object, object]]:
        for (function, arguments), label in zip(calls, labels, strict=True):
            try:
                yield label, function(*arguments)
            except Exception as error:
                yield label, error


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A registered method `fake` that answers with `module.times` in turn; its artifact can change."""
    module = types.ModuleType("fake_method")
    module.SETTINGS = {"default": None, "other": None}
    module.calls = []
    module.times = [0.5]
    module.artifact_name = "one"
    module.artifacts = lambda case, regime, settings: (Artifact("policy", "fake", module.artifact_name),)

    def prepare(case: Case, regime: str, settings: Settings) -> Callable[[Instance], Solution]:
        def solve(instance: Instance) -> Solution:
            seconds = module.times[len(module.calls) % len(module.times)]
            module.calls.append(instance.id)
            if isinstance(seconds, Exception):
                raise seconds
            if seconds == "none":
                return Solution(Status.INFEASIBLE, error="no way")
            schedule = Schedule(instance.grid[[0, -1]], 0 * instance.p_initial(case)[None].repeat(2, 0))
            return Solution(Status.OPTIMAL, schedule, build_s=0.1, setup_s=None, solve_s=seconds)

        return solve

    module.prepare = prepare
    monkeypatch.setitem(sys.modules, "fake_method", module)
    monkeypatch.setitem(METHODS, "fake", Method("fake", "fake_method", "Fake"))
    monkeypatch.setattr(timing, "Workers", Inline)
    return module


@pytest.fixture
def instances(threebus: Case) -> list[Instance]:
    return [sample_instance(threebus, 1, i) for i in range(3)]


def test_the_first_solve_is_a_warm_up(fake, threebus: Case, instances: list[Instance]) -> None:
    fake.times = [100.0, 1.0, 2.0, 3.0]
    measured = measure(threebus, instances, "fake", "TO", Settings(), repeats=1)
    assert measured.first.solve_s == 100.0
    assert [s.solve_s for s in measured.solutions] == [1.0, 2.0, 3.0]
    assert fake.calls == [instances[0].id, *(i.id for i in instances)]
    assert all(s.schedule is None for s in measured.solutions)  # schedules would clog the pipe


def test_median_and_quartiles_over_instances_and_repeats(fake, threebus, instances) -> None:
    fake.times = [9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    (row,) = bench_methods(threebus, instances, ["fake"], ["TO"], Settings(), repeats=2)
    assert (row.solve_s_q1, row.solve_s, row.solve_s_q3) == (2.25, 3.5, 4.75)
    assert (row.instances, row.repeats, row.failures) == (3, 2, 0)
    assert (row.first_build_s, row.build_s) == (0.1, 0.1)
    assert row.setup_s is None  # the method does not tell: not available, not zero
    assert row.load_average is not None


@pytest.mark.parametrize(("seconds", "repeats"), [(30.0, 1), (0.1, 6), (1e-6, MAX_REPEATS)])
def test_fast_methods_are_repeated_more_often(fake, threebus, instances, seconds, repeats) -> None:
    fake.times = [seconds]
    (row,) = bench_methods(threebus, instances, ["fake"], ["TO"], Settings())
    assert row.repeats == repeats


def test_a_method_that_does_not_time_itself_is_timed(fake, threebus, instances) -> None:
    fake.times = [None]
    (row,) = bench_methods(threebus, instances, ["fake"], ["TO"], Settings(), repeats=1)
    assert row.solve_s is not None
    assert 0 < row.solve_s < 1


def test_torch_uses_one_thread(fake, threebus, instances) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        measure(threebus, instances, "fake", "TO", Settings(), repeats=1)
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def test_failed_solves_are_counted_and_not_timed(fake, threebus, instances) -> None:
    fake.times = [1.0, 1.0, "none", 3.0]
    (row,) = bench_methods(threebus, instances, ["fake"], ["TO"], Settings(), repeats=1)
    assert (row.failures, row.solve_s, row.error) == (1, 2.0, "")


@pytest.mark.parametrize("times", [["none"], [RuntimeError("broken")]])
def test_a_method_that_only_fails_is_a_row_with_its_error(fake, threebus, instances, times) -> None:
    fake.times = times
    (row,) = bench_methods(threebus, instances, ["fake"], ["TO"], Settings(), repeats=1)
    assert row.solve_s is None
    assert row.failures == 3
    assert ("no way" in row.error) or ("broken" in row.error)


def test_finished_rows_are_not_timed_again(fake, threebus, instances, tmp_path: Path) -> None:
    def bench(**options: object) -> int:
        fake.calls.clear()
        bench_folder(tmp_path, threebus, instances, ["fake"], ["NO", "TO"], Settings(), repeats=1, **options)
        return len(fake.calls)

    assert bench() == 2 * 4
    first = (tmp_path / "timing.csv").read_bytes()
    assert bench() == 0
    assert (tmp_path / "timing.csv").read_bytes() == first
    assert bench(force=True) == 2 * 4
    fake.artifact_name = "another policy"
    assert bench() == 2 * 4
    assert len(read_timing(tmp_path / "timing.csv")) == 2  # replaced, not added


def test_rows_of_other_hosts_and_errors_do_not_count_as_finished(fake, threebus, instances, tmp_path) -> None:
    options = {"repeats": 1}
    (row,) = bench_folder(tmp_path, threebus, instances, ["fake"], ["TO"], Settings(), **options)
    for other in (dataclasses.replace(row, host="elsewhere"), dataclasses.replace(row, error="broken")):
        fake.calls.clear()
        (tmp_path / "timing.csv").write_text(format_timing([other]))
        bench_folder(tmp_path, threebus, instances, ["fake"], ["TO"], Settings(), **options)
        assert fake.calls
    assert len(read_timing(tmp_path / "timing.csv")) == 1  # the error is replaced, where it was made


def test_rows_are_saved_one_by_one(fake, threebus, instances, tmp_path, monkeypatch) -> None:
    """What was timed before an interruption is there, and is not timed again."""
    interrupted = []

    class Stops(Inline):
        def imap(self, calls, labels) -> Iterator[tuple[object, object]]:
            if fake.calls and not interrupted:
                interrupted.append(True)
                raise KeyboardInterrupt
            return super().imap(calls, labels)

    monkeypatch.setattr(timing, "Workers", Stops)
    with pytest.raises(KeyboardInterrupt):
        bench_folder(tmp_path, threebus, instances, ["fake"], ["NO", "TO"], Settings(), repeats=1)
    assert [row.regime for row in read_timing(tmp_path / "timing.csv")] == ["NO"]
    fake.calls.clear()
    bench_folder(tmp_path, threebus, instances, ["fake"], ["NO", "TO"], Settings(), repeats=1)
    assert len(fake.calls) == 4
    assert [row.regime for row in read_timing(tmp_path / "timing.csv")] == ["NO", "TO"]


@pytest.mark.parametrize(
    ("methods", "regimes", "settings"),
    [(["nope"], ["TO"], "default"), (["fake"], ["XX"], "default"), (["fake"], ["TO"], "nope")],
)
def test_bad_input(fake, threebus, instances, methods, regimes, settings) -> None:
    with pytest.raises(InputError):
        bench_methods(threebus, instances, methods, regimes, Settings(name=settings))
    with pytest.raises(InputError, match="at least one"):
        bench_methods(threebus, [], ["fake"], ["TO"], Settings())


def test_full_ded_in_a_process_of_its_own(threebus: Case, tmp_path: Path) -> None:
    """The real thing: build and set-up of the first solve cost more than those of the timed ones."""
    instance = sample_instance(threebus, 1, 0).model_copy(update={"horizon_s": 1.0})
    rows = bench_folder(
        tmp_path, threebus, [instance], ["ded"], ["TO"], Settings(), repeats=2, problems_version="v"
    )
    assert rows == read_timing(tmp_path / "timing.csv")
    (row,) = rows
    assert (row.failures, row.error, row.repeats, row.problems_version) == (0, "", 2, "v")
    assert row.solve_s is not None
    assert 0 < row.solve_s < 30
    assert row.first_build_s is not None
    assert row.build_s is not None
    assert row.first_build_s > row.build_s
    assert "ipopt" in row.solver_version


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "timing.csv"
    rows = [ROW, dataclasses.replace(ROW, regime="NO", solve_s=1 / 3, error='a, "b"\nc', load_average=None)]
    path.write_text(format_timing(rows))
    assert read_timing(path) == rows
    assert read_timing(tmp_path / "none.csv") == []


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda text: text.replace("solve_s,", "", 1), "solve_s"),
        (lambda text: text.replace("regime,", "regime,extra,", 1), "extra"),
        (lambda text: text.replace("regime,", "regime,regime,", 1), "regime"),
        (lambda text: text.replace(",3.5,", ",nan,"), "solve_s"),
        (lambda text: text.replace(",3.5,", ",-1,"), "solve_s"),
        (lambda text: text.replace(",10,", ",ten,"), "instances"),
        (lambda text: text.replace(",10,", ",,"), "instances"),
        (lambda text: text.replace("TO,", ",", 1), "regime"),
        (lambda text: text.replace("TO,", "TO,TO,", 1), "line 2"),
        (lambda text: "", "regime"),
        (lambda text: text + '"', "line 3"),
    ],
)
def test_a_wrong_timing_table_names_the_field(tmp_path: Path, change, field: str) -> None:
    path = tmp_path / "timing.csv"
    path.write_text(change(format_timing([ROW])))
    with pytest.raises(InputError) as caught:
        read_timing(path)
    assert caught.value.source == str(path)
    assert field in caught.value.field


def test_a_timing_table_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError):
        read_timing(tmp_path / "timing.csv")


def test_only_the_latest_hosts_times_count() -> None:
    frame = timing_frame(
        [
            dataclasses.replace(ROW, host="old", date="2025-01-01T00:00:00Z"),
            dataclasses.replace(ROW, host="new", date="2026-05-01T00:00:00Z"),
            dataclasses.replace(ROW, host="new", regime="NO", date="2024-05-01T00:00:00Z"),
            dataclasses.replace(ROW, host="old", regime="NO", date="2026-04-30T23:59:59Z"),
        ]
    )
    assert set(latest_host(frame)["host"]) == {"new"}
    assert len(latest_host(frame)) == 2
    assert len(latest_host(timing_frame([]))) == 0
    assert list(timing_frame([]).columns) == list(COLUMNS)


def test_the_sample_is_spread_and_the_same_every_time(threebus: Case) -> None:
    many = [sample_instance(threebus, 1, i) for i in range(25)]
    chosen = choose_sample(many, 5)
    assert [i.id for i in chosen] == [many[k].id for k in (0, 6, 12, 18, 24)]
    assert choose_sample(many[:3], 5) == many[:3]


def test_runs_of_a_results_table(fake) -> None:
    """Settings come back from the keys; strangers and models from files do not."""
    keys = [
        Key("a", "TO", "fake", "default"),
        Key("b", "NO", "fake", "default"),
        Key("a", "TO", "fake", "other-linear"),
        Key("a", "TO", "fake", "default-myfile"),
        Key("a", "TO", "stranger", "default"),
    ]
    runs = runs_of(keys, Settings(time_limit_s=9.0))
    assert runs == [
        ("fake", ["NO", "TO"], Settings(time_limit_s=9.0)),
        ("fake", ["TO"], Settings(name="other", model="linear", time_limit_s=9.0)),
    ]
