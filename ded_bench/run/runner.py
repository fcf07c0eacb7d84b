"""Run instance × regime × method × settings: resume, workers here or on a cluster, one row each."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from ded_bench.files.table import LARGEST
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.rows import Results, Row
from ded_bench.run.cluster import open_workers
from ded_bench.run.code import code_of_method, named
from ded_bench.run.environment import host, now, version
from ded_bench.run.scoring import save_scores
from ded_bench.run.shipping import pack
from ded_bench.run.tasks import Task, failed, solve_task

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
            artifacts = method.artifacts(case, regime, settings)
            code = code_of_method(method, settings.name, artifacts)
            for instance, split in instances:
                fingerprint = fingerprint_of(case, instance, regime, method.name, settings, artifacts)
                task = Task(instance, split, regime, method.name, settings, fingerprint, artifacts, code)
                tasks.append(task)
    return tasks


def fingerprint_of(
    case: Case,
    instance: Instance,
    regime: str,
    method: str,
    settings: Settings,
    artifacts: Sequence[Artifact],
) -> str:
    """Twelve hex digits that change with whatever decides on an answer, except for our own code."""
    parts = [case.fingerprint, instance.fingerprint, regime, method, settings.slug]
    parts += [artifact.fingerprint for artifact in artifacts]
    parts += [f"time limit {settings.time_limit_s:g} s"] if settings.time_limit_s is not None else []
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]


def fallbacks(tasks: Sequence[Task], folder: Path) -> list[str]:
    """What methods take from elsewhere than this results folder without having been told to: a line each."""
    lines = []
    for task in tasks:
        given = {task.settings.policy, Path(task.settings.model)}
        for artifact in task.artifacts:
            if artifact.path and artifact.path not in given and not artifact.path.is_relative_to(folder):
                what = f"{artifact.kind} {artifact.name}@{artifact.fingerprint}"
                lines.append(f"{task.method} {task.regime}: {what} from {artifact.path}")
    return list(dict.fromkeys(lines))


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
    todo, unscored = unfinished(tasks, results)
    with open_workers(workers, scheduler) as pool, contextlib.ExitStack() as stack:
        if todo or unscored:
            stack.callback(results.compact)  # also after an interruption
        calls = [(solve_task, (case, task)) for task in (_packed(todo) if scheduler else todo)]
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
        save_scores(case, unscored, results, pool, on_row)
    return [results.rows[task.key] for task in tasks]


def unfinished(tasks: Sequence[Task], results: Results) -> tuple[list[Task], list[Task]]:
    """Tasks that are to be solved and scored, and those that are solved and only to be scored."""
    missing = [task for task in tasks if not results.has(task.key, task.fingerprint)]
    solved = [results.solved(task.key, task.fingerprint) for task in missing]
    todo = [task for task, done in zip(missing, solved, strict=True) if not done]
    return todo, [task for task, done in zip(missing, solved, strict=True) if done]


def _packed(tasks: Sequence[Task]) -> Iterator[Task]:
    """Tasks with the files that their answers depend on."""
    files = functools.cache(pack)
    for task in tasks:
        yield dataclasses.replace(task, files=files(task.settings, task.artifacts))


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
        time_limit_s=task.settings.time_limit_s,
        model=named(task.artifacts, "model"),
        policy=named(task.artifacts, "policy"),
        code=task.code,
    )


def _storable(value: float | None) -> float | None:
    return value if value is not None and abs(value) <= LARGEST else None
