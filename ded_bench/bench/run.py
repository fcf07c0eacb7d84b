"""Run instance × regime × method × settings: resume, worker processes, one row each."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import hashlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for
from typing import TypeVar

from tqdm import tqdm

from ded_bench.bench.environment import host, now, version
from ded_bench.bench.results import Key, Results, Row
from ded_bench.methods import get_method
from ded_bench.methods.solution import Settings, Solution, Solver, Status
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.score import Score, score_many
from ded_bench.truth.simulate import SimulationError

#: Schedules scored side by side in one task; more gains little, fewer costs overhead.
SCORE_BATCH = 50
#: A task whose worker dies this often becomes a row with its error.
ATTEMPTS = 3
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Task:
    """One row to be made."""

    instance: Instance
    split: str
    regime: str
    method: str
    settings: Settings
    fingerprint: str

    @property
    def key(self) -> Key:
        """The row's place in the results table."""
        return Key(self.instance.id, self.regime, self.method, self.settings.slug)


def make_tasks(
    case: Case,
    instances: Sequence[tuple[Instance, str]],
    methods: Sequence[str],
    regimes: Sequence[str],
    settings: Settings,
) -> list[Task]:
    """List every row of a run; methods and regimes outermost, so that a worker's model is reused.

    Raises:
        InputError: unknown method, regime or settings, or a model or policy that is missing.
    """
    case.check_regimes(regimes)
    tasks = []
    for method in methods:
        for regime in regimes:
            artifact = get_method(method).artifact(case, regime, settings)
            for instance, split in instances:
                parts = (case.fingerprint, instance.fingerprint, regime, method, settings.slug, artifact)
                fingerprint = hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
                tasks.append(Task(instance, split, regime, method, settings, fingerprint))
    return tasks


def run(
    case: Case,
    tasks: Sequence[Task],
    results: Results,
    workers: int = 1,
    problems_version: str = "",
    on_row: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Solve and score what the results folder lacks; every row is saved as soon as it exists.

    Finished rows are skipped, solved ones are only scored. A worker that dies costs its tasks one
    attempt; after three a task becomes a row with its error.

    Returns:
        The rows of all tasks, old and new, in the order of the tasks.
    """
    todo = [task for task in tasks if not results.solved(task.key, task.fingerprint)]
    unscored = [
        task
        for task in tasks
        if results.solved(task.key, task.fingerprint) and not results.has(task.key, task.fingerprint)
    ]
    with Workers(workers) as pool, tqdm(total=len(todo), unit="row", disable=None, desc="solve") as bar:
        for task, answer in pool.imap([(solve_task, (case, task)) for task in todo], todo):
            solution = answer if isinstance(answer, Solution) else failed(answer)
            if solution.schedule is not None:
                solution.schedule.write(results.schedule_path(task.key), case.generators)
                unscored.append(task)
            row = _row(task, solution, workers, problems_version)
            results.add([row])
            if solution.schedule is None:
                on_row(row)
            bar.set_postfix_str(f"{task.method} {task.regime} {solution.status}")
            bar.update()
    _score(case, unscored, results, workers, on_row)
    return [results.rows[task.key] for task in tasks]


def _score(
    case: Case, tasks: Sequence[Task], results: Results, workers: int, on_row: Callable[[Row], None]
) -> None:
    batches = list(_batches(tasks))
    calls = []
    for batch in batches:
        schedules = [results.schedule(task.key, case, task.instance) for task in batch]
        calls.append((score_tasks, (case, batch, schedules)))
    with (
        Workers(min(workers, len(batches))) as pool,
        tqdm(total=len(tasks), unit="row", disable=None, desc="score") as bar,
    ):
        for batch, answer in pool.imap(calls, batches):
            rows = []
            for i, task in enumerate(batch):
                row = results.rows[task.key]
                verdict = answer[i] if isinstance(answer, list) else answer
                if isinstance(verdict, Score):
                    row = scored_row(row, verdict)
                else:
                    row = dataclasses.replace(row, error=f"scoring failed: {_reason(verdict)}")
                rows.append(row)
            results.add(rows)
            for row in rows:
                on_row(row)
            bar.update(len(batch))


def solve_task(case: Case, task: Task) -> Solution:
    """Solve one task in this process; a method that raises gives a failed Solution."""
    try:
        return _prepared(case, task.method, task.regime, task.settings)(task.instance)
    except Exception as error:  # the boundary to other people's methods: a failure is a row
        return failed(error)


def score_tasks(
    case: Case, tasks: Sequence[Task], schedules: Sequence[Schedule]
) -> list[Score | BaseException]:
    """Score tasks of one time grid side by side; if one loses synchronism, each on its own."""
    regimes = [task.regime for task in tasks]
    try:
        return list(score_many(case, [task.instance for task in tasks], schedules, regimes))
    except SimulationError as error:
        if len(tasks) == 1:
            return [error]
        middle = len(tasks) // 2
        return score_tasks(case, tasks[:middle], schedules[:middle]) + score_tasks(
            case, tasks[middle:], schedules[middle:]
        )


def failed(error: object) -> Solution:
    """A Solution for a method that raised, or whose worker died."""
    return Solution(Status.FAILED, error=_reason(error))


def scored_row(row: Row, verdict: Score) -> Row:
    """A row with the scorer's verdict filled in."""
    return dataclasses.replace(
        row,
        feasible=verdict.feasible,
        feasible_strict=verdict.feasible_strict,
        **dataclasses.asdict(verdict),
    )


@functools.lru_cache(maxsize=4)
def _prepared(case: Case, method: str, regime: str, settings: Settings) -> Solver:
    return get_method(method).prepare(case, regime, settings)


def _row(task: Task, solution: Solution, workers: int, problems_version: str) -> Row:
    seed = task.instance.seed
    return Row(
        instance=task.instance.id,
        split=task.split,
        regime=task.regime,
        method=task.method,
        settings=task.settings.slug,
        status=str(solution.status),
        iterations=solution.iterations,
        build_s=solution.build_s,
        setup_s=solution.setup_s,
        solve_s=solution.solve_s,
        solver_objective=solution.solver_objective,
        error=solution.error,
        workers=workers,
        problems_version=problems_version,
        version=version(),
        solver_version=solution.solver_version,
        host=host(),
        date=now(),
        case=task.instance.case,
        seed=" ".join(map(str, seed)) if isinstance(seed, tuple) else str(seed),
        fingerprint=task.fingerprint,
    )


def _batches(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    grids: dict[tuple[int, float], list[Task]] = {}
    for task in tasks:
        grids.setdefault((task.instance.steps, task.instance.dt_s), []).append(task)
    for group in grids.values():
        for start in range(0, len(group), SCORE_BATCH):
            yield group[start : start + SCORE_BATCH]


def _reason(error: object) -> str:
    """One line that a person understands."""
    if isinstance(error, BaseException):
        first = str(error).strip().splitlines()[:1]
        return f"{type(error).__name__}: {first[0] if first else 'no message'}"[:300]
    return str(error)[:300]


T = TypeVar("T")
Call = tuple[Callable[..., object], tuple[object, ...]]


class Workers:
    """Worker processes with one thread each, restarted when one dies."""

    def __init__(self, count: int) -> None:
        self.count = max(count, 1)
        self._pool: ProcessPoolExecutor | None = None
        self._threads = {name: os.environ.get(name) for name in THREAD_VARIABLES}

    def __enter__(self) -> Workers:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # inherited by the workers
        return self

    def __exit__(self, kind: object, value: object, trace: object) -> None:
        for name, before in self._threads.items():
            if before is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = before
        self._stop(kill=kind is not None)

    def imap(self, calls: Sequence[Call], labels: Iterable[T]) -> Iterator[tuple[T, object]]:
        """Yield (label, result or exception) of every call, in the order in which they finish."""
        waiting = [(label, call, 1) for label, call in zip(labels, calls, strict=True)][::-1]
        running: dict[Future[object], tuple[T, Call, int]] = {}
        suspects = 0  # after a death, run one at a time so that only the guilty task is blamed
        while waiting or running:
            while waiting and len(running) < (1 if suspects else 2 * self.count):
                label, (function, arguments), attempt = waiting.pop()
                try:
                    future = self._executor().submit(function, *arguments)
                except BrokenProcessPool:  # a worker died since the last answer
                    waiting.append((label, (function, arguments), attempt))
                    if running:
                        break  # they hear of it below
                    self._stop(kill=True)
                    continue
                running[future] = (label, (function, arguments), attempt)
            done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            died = []
            for future in done:
                label, call, attempt = running.pop(future)
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    died.append((label, call, attempt))
                else:
                    suspects = max(suspects - 1, 0)
                    yield label, (error if error is not None else future.result())
            if died:
                died += running.values()
                running.clear()
                self._stop(kill=True)
                alone = len(died) == 1
                suspects = len(died)
                for label, call, attempt in died:
                    if alone and attempt >= ATTEMPTS:
                        suspects = 0
                        yield label, f"the worker process died {ATTEMPTS} times on this task"
                    else:
                        waiting.append((label, call, attempt + alone))

    def _executor(self) -> ProcessPoolExecutor:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.count, context, initializer=_start_worker)
        return self._pool

    def _stop(self, kill: bool) -> None:
        if self._pool is None:
            return
        if kill:
            for process in list((self._pool._processes or {}).values()):
                process.kill()
        self._pool.shutdown(wait=not kill, cancel_futures=True)
        self._pool = None


def _start_worker() -> None:
    """Leave Ctrl-C to the main process, and die with it."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            wait_for([parent.sentinel])
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
