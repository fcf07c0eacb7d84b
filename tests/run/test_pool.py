"""Worker processes on this machine: they crash, hang, are killed and are never left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ded_bench.run.pool import ATTEMPTS, NoAnswerError, WorkerDiedError, Workers


def crash(number: int) -> None:
    os.kill(os.getpid(), number)


def sleep_and_tell(seconds: float, path: str) -> None:
    """Write who is sleeping here, and what it has started."""
    other = subprocess.Popen(["sleep", str(seconds)])
    Path(path).write_text(f"{os.getpid()} {other.pid}")
    time.sleep(seconds)


def die_once(path: str) -> str:
    if not Path(path).exists():
        Path(path).touch()
        os._exit(3)
    return "alive"


def speak() -> str:
    print("a method that prints")
    return os.environ["OMP_NUM_THREADS"]


class MoodyError(Exception):
    """Cannot be unpickled: it wants two arguments."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(first)


def raise_moody() -> None:
    raise MoodyError("a", "b")


def make_lambda() -> object:
    return lambda: None


def wait_until(condition, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def runs(pid: int) -> bool:
    """Whether a process computes: neither gone nor a zombie that nobody has waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_every_call_is_answered_once_whatever_it_does(tmp_path: Path, capfd) -> None:
    calls = {
        "plain": (abs, (-7,)),
        "raises": (divmod, (1, 0)),
        "leaves": (sys.exit, (5,)),
        "segfault": (crash, (signal.SIGSEGV,)),
        "once": (die_once, (str(tmp_path / "once"),)),
        "threads": (speak, ()),
        "unreadable": (raise_moody, ()),
        "unsendable": (make_lambda, ()),
        "unreadable here": (abs, (MoodyError("a", "b"),)),
    }
    with Workers(2) as pool:
        assert pool.count == 2
        answers = dict(pool.imap(list(calls.values()), list(calls)))
    assert answers.keys() == calls.keys()
    assert answers["plain"] == 7
    assert isinstance(answers["raises"], ZeroDivisionError)
    assert isinstance(answers["leaves"], SystemExit)
    assert isinstance(answers["segfault"], WorkerDiedError)
    assert f"died {ATTEMPTS} times" in str(answers["segfault"])
    assert "Segmentation fault" in str(answers["segfault"])
    assert answers["once"] == "alive"
    assert answers["threads"] == "1"
    assert "cannot be read" in str(answers["unreadable"])
    assert "cannot be sent" in str(answers["unsendable"])
    assert isinstance(answers["unreadable here"], TypeError)
    assert capfd.readouterr().out == ""  # rows go there


def test_a_hang_costs_its_own_process_only(tmp_path: Path) -> None:
    calls = [(sleep_and_tell, (60.0, str(tmp_path / "pids")))] + [(abs, (-i,)) for i in range(5)]
    with Workers(2) as pool:
        started = time.monotonic()
        answers = dict(pool.imap(calls, range(6), [5.0, *[None] * 5]))
        assert time.monotonic() - started < 30.0
    assert isinstance(answers[0], NoAnswerError)
    assert "5 s" in str(answers[0])
    assert [answers[i] for i in range(1, 6)] == [0, 1, 2, 3, 4]
    for pid in (tmp_path / "pids").read_text().split():  # what it had started is gone, too
        wait_until(lambda pid=pid: not runs(int(pid)))


def test_a_worker_killed_between_two_calls_costs_nothing() -> None:
    with Workers(1) as pool:
        answers = pool.imap([(os.getpid, ()) for _ in range(5)], range(5))
        _, pid = next(answers)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not runs(pid))
        rest = dict(answers)
    assert len(rest) == 4
    assert all(isinstance(answer, int) for answer in rest.values())


def test_an_interruption_leaves_no_process(tmp_path: Path) -> None:
    pids = tmp_path / "pids"

    def interrupted() -> None:
        with Workers(2) as pool:
            calls = [(sleep_and_tell, (60.0, str(pids))), (abs, (-1,))]
            assert next(pool.imap(calls, "ab")) == ("b", 1)
            wait_until(lambda: pids.exists() and pids.read_text())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    for pid in pids.read_text().split():
        wait_until(lambda pid=pid: not runs(int(pid)))


def test_modules_of_the_working_directory_shadow_no_others(tmp_path: Path) -> None:
    """A command may be called within a folder that comes from a stranger."""
    (tmp_path / "queue.py").write_text("raise SystemExit('a stranger speaks')")
    code = (
        "import sys; sys.path.remove('')\n"  # as in `ded-bench`
        "from ded_bench.run.pool import Workers; import math\n"
        "with Workers(1) as pool: print([answer for _, answer in pool.imap([(math.sqrt, (4.0,))], 'a')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert done.stdout == "[2.0]\n", done.stderr


def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    """Even if it is killed, and they are in the middle of something."""
    pids = tmp_path / "pids"
    code = (
        "from ded_bench.run.pool import Workers; from tests.run.test_pool import sleep_and_tell\n"
        f"with Workers(1) as pool: list(pool.imap([(sleep_and_tell, (60.0, {str(pids)!r}))], 'a'))"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    wait_until(lambda: pids.exists() and pids.read_text())
    parent.kill()
    parent.wait()
    for pid in pids.read_text().split():
        wait_until(lambda pid=pid: not runs(int(pid)))
