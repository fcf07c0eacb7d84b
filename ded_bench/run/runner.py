"""Run instance × regime × method × settings: resume, workers here or on a cluster, one row each."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence

from tqdm import tqdm

from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.cluster import open_workers
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.results import LARGEST, Results, Row
from ded_bench.run.shipping import Files, pack
from ded_bench.run.tasks import Task, failed, reason_of, score_tasks, solve_task
from ded_bench.truth.score import Score

#: Schedules scored side by side in one task; more gains little, fewer costs overhead.
SCORE_BATCH = 50
#: A solve that has not ended so long after its time limit never will, and is killed. It also pays for
#: what comes before the first solve of a process, imports and the building of the model: some seconds.
GRACE_S = 60.0


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
    for method in map(get_method, methods):
        for regime in regimes:
            artifacts = [a.fingerprint for a in method.artifacts(case, regime, settings)]
            for instance, split in instances:
                names = regime, method.name, settings.slug
                parts = (case.fingerprint, instance.fingerprint, *names, *artifacts)
                fingerprint = hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
                tasks.append(Task(instance, split, regime, method.name, settings, fingerprint))
    return tasks


def run(
    case: Case,
    tasks: Sequence[Task],
    results: Results,
    workers: int = 1,
    problems_version: str = "",
    on_row: Callable[[Row], None] = lambda row: None,
    scheduler: str | None = None,
) -> list[Row]:
    """Solve and score what the results folder lacks; every row is saved as soon as it exists.

    Finished rows are skipped, solved ones are only scored. A task whose process dies three times
    becomes a row with its error, and so does one that answers neither within its time limit nor GRACE_S
    after it.

    Args:
        workers: processes on this machine.
        scheduler: address of a Dask scheduler, whose workers are used instead.

    Returns:
        The rows of all tasks, old and new, in the order of the tasks.

    Raises:
        InputError: no scheduler answers.
        WorkersLostError: it answers no more, or its workers cannot run this package.
    """
    todo = [task for task in tasks if not results.solved(task.key, task.fingerprint)]
    unscored = [
        task
        for task in tasks
        if results.solved(task.key, task.fingerprint) and not results.has(task.key, task.fingerprint)
    ]
    with open_workers(workers, scheduler) as pool:
        calls = [(solve_task, (case, task)) for task in (_packed(case, todo) if scheduler else todo)]
        limits = [limit and limit + GRACE_S for limit in (task.settings.time_limit_s for task in todo)]
        with tqdm(total=len(todo), unit="row", disable=None, desc="solve") as bar:
            for task, answer in pool.imap(calls, todo, limits):
                lost = failed(answer), "" if scheduler else host()
                solution, where = answer if isinstance(answer, tuple) else lost
                if solution.schedule is not None:
                    solution.schedule.write(results.schedule_path(task.key), case.generators)
                    unscored.append(task)
                else:  # one of an earlier model or policy must not pass for this row's
                    results.schedule_path(task.key).unlink(missing_ok=True)
                row = unscored_row(task, solution, pool.count, problems_version, where)
                results.add([row])
                if solution.schedule is None:
                    on_row(row)
                bar.set_postfix_str(f"{task.method} {task.regime} {solution.status}")
                bar.update()
        _score(case, unscored, results, pool, on_row)
    return [results.rows[task.key] for task in tasks]


def _packed(case: Case, tasks: Sequence[Task]) -> Iterator[Task]:
    """Tasks with all that their methods may look for in a results folder."""

    @functools.cache
    def files(method: str, regime: str, settings: Settings) -> Files:
        return pack(settings, get_method(method).artifacts(case, regime, settings))

    for task in tasks:
        yield dataclasses.replace(task, files=files(task.method, task.regime, task.settings))


def _score(
    case: Case, tasks: Sequence[Task], results: Results, pool: Workers, on_row: Callable[[Row], None]
) -> None:
    batches = list(_batches(tasks))

    def schedules(batch: Sequence[Task]) -> list[Schedule]:
        return [results.schedule(task.key, case, task.instance) for task in batch]

    calls = ((score_tasks, (case, batch, schedules(batch))) for batch in batches)  # read as they are needed
    with tqdm(total=len(tasks), unit="row", disable=None, desc="score") as bar:
        for batch, answer in pool.imap(calls, batches):
            rows = []
            for i, task in enumerate(batch):
                verdict = answer[i] if isinstance(answer, list) else answer
                rows.append(scored_row(results.rows[task.key], verdict))
            results.add(rows)
            for row in rows:
                on_row(row)
            bar.update(len(batch))


def scored_row(row: Row, verdict: object) -> Row:
    """A row with the scorer's verdict filled in, or with the reason why there is none."""
    if not isinstance(verdict, Score):
        return dataclasses.replace(row, error=f"scoring failed: {reason_of(verdict)}")
    numbers = dataclasses.asdict(verdict)
    if None in map(_storable, numbers.values()):
        return dataclasses.replace(row, error="scoring failed: cost or violations are beyond all measure")
    return dataclasses.replace(
        row, feasible=verdict.feasible, feasible_strict=verdict.feasible_strict, **numbers
    )


def unscored_row(task: Task, solution: Solution, workers: int, problems_version: str, where: str) -> Row:
    """The row of a task with what the solver claims; `where` is the host that solved it."""
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
        solver_objective=_storable(solution.solver_objective),
        error=solution.error,
        workers=workers,
        problems_version=problems_version,
        version=version(),
        solver_version=solution.solver_version,
        host=where,
        date=now(),
        case=task.instance.case,
        seed=" ".join(map(str, seed)) if isinstance(seed, tuple) else str(seed),
        fingerprint=task.fingerprint,
    )


def _storable(value: float | None) -> float | None:
    return value if value is not None and abs(value) <= LARGEST else None


def _batches(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    """Tasks to be simulated side by side: of one grid, and of one method, whose schedules bend alike."""
    groups: dict[tuple[int, float, str], list[Task]] = {}
    for task in tasks:
        groups.setdefault((task.instance.steps, task.instance.dt_s, task.method), []).append(task)
    for group in groups.values():
        for start in range(0, len(group), SCORE_BATCH):
            yield group[start : start + SCORE_BATCH]
