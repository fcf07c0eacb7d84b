"""Workers on a Dask cluster, for machines that need nothing but this package.

Dask distributes; in each of its workers a process of its own runs the call (see `pool`), so that a
crash or a hang never takes a Dask worker with it. If Dask loses a whole worker, it runs the call on
another one, and gives up when `distributed.scheduler.allowed-failures` (3) more have died of it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import logging
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import ded_bench
from ded_bench.files.errors import InputError
from ded_bench.run.environment import version
from ded_bench.run.pool import Answer, Children, Workers, WorkersLostError

#: How long to wait for the scheduler to answer, s.
CONNECT_S = 10.0
#: How often to ask it for its workers, s.
REFRESH_S = 5.0
#: The processes of a Dask worker; a run leaves them to the next one on the same cluster.
_children = Children()


class Cluster(Workers):
    """Runs calls on the workers of a Dask cluster, however many there are at the moment.

    Raises:
        InputError: no scheduler answers at the address, or Dask is not installed.
    """

    def __init__(self, scheduler: str) -> None:
        try:
            distributed = importlib.import_module("distributed")  # a second, and only needed here
        except ImportError:
            problem = "needs Dask, which is not installed: pip install distributed"
            raise InputError("--scheduler", scheduler, problem) from None
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what counts is said in one line
        self._killed: type[Exception] = distributed.KilledWorker
        self._scheduler = scheduler
        try:
            self._client: Any = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
            problem = f"no Dask scheduler answers there ({reason[0][:150]}); start one with `dask scheduler`"
            raise InputError("--scheduler", scheduler, problem) from None
        self._executor = self._client.get_executor(pure=False)
        self._count, self._refreshed = 0, -REFRESH_S
        if not self.count:
            print(f"ded-bench: waiting for workers (`dask worker {scheduler}`)", file=sys.stderr)

    @property
    def count(self) -> int:
        """How many calls run at a time: the threads of all Dask workers, at least 1."""
        if time.monotonic() - self._refreshed > REFRESH_S and self._client.status == "running":
            with contextlib.suppress(OSError):  # lost just now: the futures will tell
                self._count = sum(self._client.nthreads().values())
            self._refreshed = time.monotonic()
        return max(self._count, 1)

    def __exit__(self, *_: object) -> None:
        if self._client.status == "running":
            self._client.run(rest, on_error="ignore")
        with contextlib.suppress(OSError):  # the scheduler is gone
            self._client.close(timeout=CONNECT_S)

    def _submit(self, request: bytes, limit_s: float | None) -> Future[Answer]:
        return self._executor.submit(call_here, code_version(), request, limit_s)

    def _answer(self, future: Future[Answer]) -> object:
        if future.cancelled():
            raise self._lost()
        error = future.exception()
        if error is None or isinstance(error, self._killed):
            return super()._answer(future)
        if isinstance(error, WorkersLostError):
            raise error
        reason = " ".join(str(error.__cause__ or error).split())[:150]
        raise WorkersLostError(
            f"the workers of {self._scheduler} cannot run this; is ded-bench installed there? ({reason})"
        )

    def _check(self) -> None:
        if self._client.status != "running":
            raise self._lost()

    def _lost(self) -> WorkersLostError:
        return WorkersLostError(
            f"the scheduler {self._scheduler} is gone; what was finished is saved: start it again "
            "(or leave out --scheduler) and repeat the command"
        )


def call_here(wanted: str, request: bytes, limit_s: float | None) -> Answer:
    """What a Dask worker does with a call: check that it has the same code, and pass it to a process.

    Raises:
        WorkersLostError: this worker has another version of the package.
    """
    if code_version() != wanted:
        raise WorkersLostError(
            f"a worker has ded-bench {code_version()}, but this is {wanted}; install the same version "
            "everywhere, restart the workers and repeat the command (what was finished is saved)"
        )
    return _children.call(request, limit_s)


@functools.cache
def code_version() -> str:
    """Version of this package, and of its source files: they must be equal on all machines."""
    folder = Path(ded_bench.__file__).parent
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.py"))
    content = b"".join(name.encode() + (folder / name).read_bytes() for name in files)
    return f"{version()} ({hashlib.sha256(content).hexdigest()[:8]})"


def rest() -> None:
    """End the processes of this Dask worker that have nothing to do."""
    _children.rest()
