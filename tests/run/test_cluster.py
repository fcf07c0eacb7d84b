"""A real Dask cluster of processes on this machine: workers are killed, and the scheduler, too."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Artifact, Settings, model_artifact
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.rows import Results
from ded_bench.run import cluster as module
from ded_bench.run import runner
from ded_bench.run.cluster import Cluster
from ded_bench.run.pool import WorkersLostError
from ded_bench.run.runner import run
from ded_bench.run.tasks import make_tasks, pack, solve_and_score, unpacked
from ded_bench.surrogates.find import find_model
from ded_bench.surrogates.linear import linear_model
from tests.run.test_pool import wait_until
from tests.strange_methods import STRANGE, solve_strange

ROOT = Path(__file__).parents[2]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def dask(*arguments: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A `dask` command, as in the README, far from the package and from any results folder."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments, "--no-dashboard"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Address and process of a scheduler that has two workers."""
    folder = tmp_path_factory.mktemp("cluster")
    address = f"tcp://127.0.0.1:{free_port()}"
    place = ("--host", "127.0.0.1", "--port", address.rpartition(":")[2])
    workers = ("worker", address, "--nworkers", "2", "--nthreads", "1", "--local-directory", str(folder))
    with dask("scheduler", *place, folder=folder) as process, dask(*workers, folder=folder):
        with Cluster(address) as pool:
            wait_until(lambda: len(pool._client.nthreads()) == 2, 120.0)
        yield address, process


@pytest.fixture
def address(scheduler: tuple[str, subprocess.Popen[bytes]]) -> str:
    """Where the cluster is."""
    return scheduler[0]


@pytest.fixture
def make(threebus: Case, quiet_instance):
    def make_these(*names: str, method="ded", settings=Settings()):  # noqa: B008
        instances = [(quiet_instance(threebus, id=name, horizon_s=0.5), "none") for name in names]
        return make_tasks(threebus, instances, [method], ["TO"], settings)

    return make_these


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the misbehaving method here and in worker processes."""
    monkeypatch.setitem(METHODS, "ded", STRANGE)
    monkeypatch.setattr(runner, "solve_and_score", solve_strange)


def test_rows_are_those_of_this_process(address: str, make, threebus: Case, tmp_path: Path) -> None:
    """With a model that only this side has: no worker sees the results folder."""
    linear_model(threebus).save(ResultsFolder(tmp_path / "mine").model("koopman"))
    tasks = make("a", "b", method="ded-ko", settings=Settings(search=(tmp_path / "mine",)))
    for task, row in zip(tasks, run(threebus, tasks, Results(tmp_path), scheduler=address), strict=True):
        solution, verdict, host, _ = solve_and_score(threebus, task, "lossless")
        assert solution.schedule is not None
        assert row.objective == pytest.approx(verdict.objective, rel=1e-9)  # the CSV keeps 15 digits
        assert (row.status, row.workers, row.host) == ("Optimal", 2, host)
    with Cluster(address) as pool:  # it lives on, and its memory is for others
        for pid in pool._client.run(os.getpid).values():
            wait_until(lambda pid=pid: not psutil.Process(pid).children())


def test_failures_are_rows_and_a_killed_worker_costs_nothing(
    address: str, strange, make, threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash or a hang does not reach Dask's own workers; one of these is killed from outside."""
    monkeypatch.setattr(runner, "GRACE_S", 5.0)
    names = ("slow-1", "slow-2", "crash", "hang", "raise", "calm")
    tasks = make(*names, settings=Settings(time_limit_s=1.0))
    with Cluster(address) as pool:
        before = set(pool._client.run(os.getpid).values())

        def kill_one() -> None:
            wait_until(lambda: all(psutil.Process(pid).children() for pid in before))
            os.kill(min(before), signal.SIGKILL)

        with ThreadPoolExecutor(1) as other:
            killing = other.submit(kill_one)
            rows = {row.instance: row for row in run(threebus, tasks, Results(tmp_path), scheduler=address)}
            killing.result()
        wait_until(lambda: len(pool._client.nthreads()) == 2)
        assert len(before & set(pool._client.run(os.getpid).values())) == 1
    assert {name: row.status for name, row in rows.items()} == {
        "slow-1": "Feasible",
        "slow-2": "Feasible",
        "crash": "Failed",
        "hang": "TimeLimit",
        "raise": "Failed",
        "calm": "Feasible",
    }
    assert "died 3 times" in rows["crash"].error
    assert "no answer after 6 s" in rows["hang"].error
    assert len(Results(tmp_path).rows) == 6


def test_other_code_on_a_worker_is_refused(
    address: str, make, threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "code_version", lambda: "0.0.7 (beef)")
    with pytest.raises(WorkersLostError, match=r"a worker has ded-bench .*, but this is 0\.0\.7 \(beef\)"):
        run(threebus, make("calm"), Results(tmp_path), scheduler=address)
    assert Results(tmp_path).rows == {}


def test_workers_without_the_package_are_named(
    address: str, monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    """What is missing there is said in one line; it is no fault of the tasks."""
    (tmp_path / "only_here.py").write_text("def call_here(*arguments): pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(module, "call_here", importlib.import_module("only_here").call_here)
    with (
        Cluster(address) as pool,
        pytest.raises(WorkersLostError, match=r"installed there\? .*only_here") as failure,
    ):
        list(pool.imap([(abs, (1,))], "a"))
    assert "\n" not in str(failure.value)


def test_the_death_of_the_scheduler_loses_nothing_that_was_finished(
    scheduler: tuple[str, subprocess.Popen[bytes]], strange, make, threebus: Case, tmp_path: Path
) -> None:
    """The last test of this cluster, which does not survive it."""
    address, process = scheduler
    tasks = make(*(f"slow-{i}" for i in range(6)))
    results = Results(tmp_path)

    def kill() -> None:
        wait_until(lambda: len(Results(tmp_path).rows) >= 2, 120.0)
        process.kill()

    with ThreadPoolExecutor(1) as other:
        killing = other.submit(kill)
        with pytest.raises(WorkersLostError, match=f"{address} is gone; what was finished is saved"):
            run(threebus, tasks, results, scheduler=address)
        killing.result()
    saved = Results(tmp_path).rows
    assert 2 <= len(saved) < 6
    rows = run(threebus, tasks, results)
    assert len(Results(tmp_path).rows) == 6
    assert all(row.objective is not None for row in rows)
    for key, row in saved.items():
        assert (results.rows[key].date, results.rows[key].workers) == (row.date, 2)


@pytest.mark.parametrize("address_of", [lambda: f"tcp://127.0.0.1:{free_port()}", lambda: "magic://there"])
def test_no_scheduler_is_bad_input(address_of, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_S", 1.0)
    with pytest.raises(InputError, match=r"--scheduler: .*no Dask scheduler answers"):
        Cluster(address_of())


def test_without_dask_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # then its import fails
    with pytest.raises(InputError, match=r"--scheduler: .*pip install distributed"):
        Cluster("tcp://127.0.0.1:1")


def test_what_is_shipped_is_what_was_there(threebus: Case, tmp_path: Path) -> None:
    """Models and policies arrive under the names by which methods look for them; the first folder wins."""
    model = linear_model(threebus)
    first, second = tmp_path / "first", tmp_path / "second"
    model.save(ResultsFolder(first).model("koopman"))
    model.save(ResultsFolder(second).model("koopman-paper"))
    model.save(tmp_path / "own.safetensors")
    for folder, name in ((first, "m-TO"), (second, "m-TO"), (second, "m-TO-long"), (second, "m-NO")):
        (folder / "policies").mkdir(exist_ok=True)
        (folder / "policies" / f"{name}.safetensors").write_bytes(f"{folder.name} {name}".encode())
    policy = tmp_path / "own" / "own.safetensors"  # a model and a policy given by paths may share a name
    policy.parent.mkdir()
    policy.write_bytes(b"given")
    settings = Settings(model=str(tmp_path / "own.safetensors"), policy=policy, search=(first, second))
    artifacts = (
        Artifact("policy", "m", "1", policy),
        model_artifact(threebus, settings),
        Artifact("model", "linear", "2"),
        model_artifact(threebus, dataclasses.replace(settings, model="koopman")),
        Artifact("policy", "m", "3", second / "policies" / "m-TO-long.safetensors"),
    )
    with unpacked(settings, pack(artifacts)) as own:
        (folder,) = own.search
        assert own.policy is not None
        assert own.policy.read_bytes() == b"given"
        for name in (own.model, "koopman"):
            assert find_model(threebus, name, own.search).fingerprint == model.fingerprint
        there = {path.name: path.read_bytes() for path in (folder / "policies").iterdir()}
        assert there == {"m-TO-long.safetensors": b"second m-TO-long", "own.safetensors": b"given"}
        with pytest.raises(InputError, match="koopman-paper"):
            find_model(threebus, "koopman-paper", own.search)
    assert not folder.exists()
