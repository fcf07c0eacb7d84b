"""Worker processes on this machine: calls go out, answers come back in the order in which they finish.

Every call runs in a process of its own, with one thread, that serves one call after another. It may
crash or hang, and only its own call is to blame: it is killed and replaced, and the others go on.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from multiprocessing.connection import Connection
from typing import Self, TypeVar

#: A call whose process dies this often is given up.
ATTEMPTS = 3
#: Large blocks that are freed stay with a process (glibc). MUMPS takes and frees its own in every iteration,
#: and each time the system would have to clear them: a tenth of a solve.
MEMORY_VARIABLES = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**40)}
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")

T = TypeVar("T")
Call = tuple[Callable[..., object], tuple[object, ...]]


class WorkersLostError(RuntimeError):
    """The workers cannot go on, whatever the task; the message says why and what to do."""


class WorkerDiedError(RuntimeError):
    """Every attempt at one call ended with the death of its process."""


class NoAnswerError(TimeoutError):
    """A call did not answer in time, and its process was killed."""


#: A pickle, or why there is none.
Answer = bytes | WorkerDiedError | NoAnswerError


class Workers:
    """Runs calls on this machine, `count` at a time."""

    def __init__(self, count: int = 1) -> None:
        self._count = max(count, 1)
        self._children = Children()
        self._executor: Executor = ThreadPoolExecutor(self._count)

    @property
    def count(self) -> int:
        """How many calls run at a time."""
        return self._count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes; calls that still run get no answer."""
        self._children.close()
        self._executor.shutdown(cancel_futures=True)

    def imap(
        self, calls: Iterable[Call], labels: Iterable[T], limits_s: Iterable[float | None] | None = None
    ) -> Iterator[tuple[T, object]]:
        """Yield (label, answer) of every call, in the order in which they finish.

        An answer is what the function returned or the exception that it raised; WorkerDiedError if its
        process died three times, NoAnswerError if it took longer than its limit.

        Args:
            calls: asked for one after another as processes become free, so that they may be made meanwhile.
            limits_s: seconds from a call's start in its process until it is killed, the import of the
                function's module not counted; None (for one call or all) waits for ever.

        Raises:
            WorkersLostError: no call can be answered any more.
        """
        limits = itertools.repeat(None) if limits_s is None else limits_s
        waiting = zip(labels, calls, limits)  # noqa: B905  (repeat has no end)
        running: dict[Future[Answer], T] = {}
        while True:
            wanted = max(2 * self.count - len(running), 0)  # the next one is at hand when one ends
            for label, (function, arguments), limit_s in itertools.islice(waiting, wanted):
                running[self._submit(pickle.dumps((function, arguments)), limit_s)] = label
            if not running:
                return
            done, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), self._answer(future)
            self._check()

    def _submit(self, request: bytes, limit_s: float | None) -> Future[Answer]:
        return self._executor.submit(self._children.call, request, limit_s)

    def _answer(self, future: Future[Answer]) -> object:
        error = future.exception()
        return read(future.result()) if error is None else error

    def _check(self) -> None:
        """Raise WorkersLostError if nothing will answer; here, processes are replaced."""


class Children:
    """Processes that compute for this one, started as they are needed; for any number of threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[_Child] = []
        self._busy: set[_Child] = set()
        self._closed = False

    def call(self, request: bytes, limit_s: float | None) -> Answer:
        """Pass a request, the pickle of a function and its arguments, to a process that is free.

        The answer is the pickle of what the function returned or raised; this process reads neither.
        """
        code = 0
        for _ in range(ATTEMPTS):
            child = self._take()
            try:
                answer = child.ask(request, limit_s)
            except (EOFError, OSError):
                code = self._discard(child)
                continue
            if answer is None:
                self._discard(child)
                return NoAnswerError(f"no answer after {limit_s:g} s, so its process was killed")
            self._give_back(child)
            return answer
        ending = f"exit code {code}" if code >= 0 else signal.strsignal(-code) or f"signal {-code}"
        return WorkerDiedError(f"the worker process died {ATTEMPTS} times on this task ({ending})")

    def rest(self) -> None:
        """End the processes that have nothing to do."""
        with self._lock:
            idle, self._idle = self._idle, []
        for child in idle:
            child.end()

    def close(self) -> None:
        """End all processes; calls that still run raise RuntimeError in their threads."""
        with self._lock:
            self._closed = True
            for child in self._busy:
                child.kill()
        self.rest()

    def _take(self) -> _Child:
        with self._lock:
            if self._closed:
                raise RuntimeError("the workers are closed")
            child = self._idle.pop() if self._idle else _Child()
            self._busy.add(child)
            return child

    def _give_back(self, child: _Child) -> None:
        with self._lock:
            self._busy.discard(child)
            if not self._closed:
                self._idle.append(child)
                return
        child.end()

    def _discard(self, child: _Child) -> int:
        with self._lock:  # from here on nobody else kills it, so that its number may be used again
            self._busy.discard(child)
        return child.end()


class _Child:
    """One process. It leads a group of its own, which is killed as a whole, and ends with its parent."""

    def __init__(self) -> None:
        self._connection, theirs = multiprocessing.Pipe()
        code = f"from ded_bench.run.pool import serve; serve({theirs.fileno()})"
        places = [place or os.getcwd() for place in sys.path if not place or os.path.isabs(place)]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", code],  # no module of the working directory shadows others
                env=os.environ
                | dict.fromkeys(THREAD_VARIABLES, "1")
                | MEMORY_VARIABLES
                | {"PYTHONPATH": os.pathsep.join(places)},
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,  # what a method prints is no row
                start_new_session=True,
            )

    def ask(self, request: bytes, limit_s: float | None) -> bytes | None:
        """Answer to a request, None if there is none in time; EOFError or OSError if the process died."""
        self._connection.send_bytes(request)
        self._connection.recv_bytes()  # the request is read and its modules imported: the clock starts
        return self._connection.recv_bytes() if self._connection.poll(limit_s) else None

    def kill(self) -> None:
        """Kill the process and what it has started; whoever waits for its answer hears of it."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def end(self) -> int:
        """Kill the process and clean up; returns how it ended, as `Popen.returncode` does."""
        self.kill()
        self._connection.close()
        return self._process.wait()


def serve(file_descriptor: int) -> None:
    """What a child process does: answer one request after another until its parent is gone."""
    os.set_inheritable(file_descriptor, False)
    connection = Connection(file_descriptor)
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                requests.put(connection.recv_bytes())
        except (EOFError, OSError):  # also in the middle of a long solve
            os.killpg(os.getpid(), signal.SIGKILL)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        try:
            request = requests.get()
            try:
                function, arguments = pickle.loads(request)  # from our own parent alone
            finally:
                connection.send_bytes(b"")
            answer = function(*arguments)
        except BaseException as error:  # even sys.exit() of a method is only its answer
            error.add_note("".join(traceback.format_exception(error)))  # which does not travel by itself
            answer = error
        try:
            content = pickle.dumps(answer)
        except Exception as error:
            content = pickle.dumps(RuntimeError(f"the answer cannot be sent: {error}"))
        connection.send_bytes(content)


def read(answer: Answer) -> object:
    """What a call returned, or the exception that came instead."""
    if not isinstance(answer, bytes):
        return answer
    try:
        return pickle.loads(answer)  # from our own child, or a worker of our own cluster
    except Exception as error:  # an exception class may want more than its message
        return RuntimeError(f"the answer cannot be read: {error}")
