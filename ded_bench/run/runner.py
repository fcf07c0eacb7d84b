"""Run tasks: resume, workers here or on a cluster, one row each."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from ded_bench.files.table import LARGEST
from ded_bench.methods.solution import Solution, named
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Case
from ded_bench.results.rows import Results, Row
from ded_bench.run.cluster import Cluster
from ded_bench.run.environment import commit, host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.scoring import scored_row
from ded_bench.run.tasks import Answered, Task, failed, pack, solve_and_score, trace_of

#: A solve that has not ended so long after its time limit never will, and is killed. It also pays for
#: what comes before the first solve of a process, imports and the building of the model: some seconds.
GRACE_S = 60.0


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

    Finished rows are skipped. A task whose process dies three times becomes a row with its error, and so does
    one that answers neither within its time limit nor GRACE_S after it.

    Args:
        case: of all tasks.
        tasks: see `make_tasks`.
        results: where rows and schedules are saved.
        workers: processes on this machine.
        problems_version: of the problem files.
        on_row: called with each new row.
        scheduler: address of a Dask scheduler, whose workers are used instead.

    Returns:
        The rows of all tasks, old and new, in the order of the tasks.

    Raises:
        InputError: no scheduler answers.
        WorkersLostError: it answers no more, or its workers cannot run this package.
    """
    todo, plant = unfinished(tasks, results), plant_of(case).name
    with Cluster(scheduler) if scheduler else Workers(workers) as pool, results.packed():
        sent = todo if scheduler is None else _packed(todo)
        calls = ((solve_and_score, (case, task, plant)) for task in sent)
        limits = [limit and limit + GRACE_S for limit in (task.settings.time_limit_s for task in todo)]
        with tqdm(total=len(todo), unit="row", disable=None, desc="solve") as bar:
            for task, answer in pool.imap(calls, todo, limits):
                lost = Answered(failed(answer), None, "" if scheduler else host(), trace_of(answer))
                solution, verdict, where, trace = answer if isinstance(answer, Answered) else lost
                if trace:
                    results.paths.log_failure(f"{task.method} {task.regime} {task.instance.id}", trace)
                row = unscored_row(task, solution, plant, pool.count, problems_version, where)
                row = row if solution.schedule is None else scored_row(row, verdict)
                results.keep(row, solution.schedule, case)
                on_row(row)
                bar.set_postfix_str(f"{task.method} {task.regime} {solution.status}")
                bar.update()
    return [results.rows[task.key] for task in tasks]


def unfinished(tasks: Sequence[Task], results: Results) -> list[Task]:
    """The tasks without a finished row (see `Results.finished`)."""
    return [task for task in tasks if not results.finished(task.key, task.fingerprint, task.version)]


def _packed(tasks: Sequence[Task]) -> Iterator[Task]:
    """Tasks with the files that their answers depend on."""
    files = functools.cache(pack)
    for task in tasks:
        yield dataclasses.replace(task, files=files(task.artifacts))


def unscored_row(
    task: Task, solution: Solution, plant: str, workers: int, problems_version: str, where: str
) -> Row:
    """The row of a task with what the solver claims; `where` is the host that solved it."""
    seed, objective = task.instance.seed, solution.solver_objective
    claimed = {
        f.name: getattr(solution, f.name) for f in dataclasses.fields(Solution) if f.name != "schedule"
    }
    claimed["solver_objective"] = objective if objective is not None and abs(objective) <= LARGEST else None
    return Row(
        **task.key._asdict(),
        **claimed | {"status": str(solution.status)},
        split=task.split,
        plant=plant,
        workers=workers,
        problems_version=problems_version,
        version=version(),
        commit=commit(),
        method_version=task.version,
        host=where,
        date=now(),
        seed=" ".join(map(str, seed)) if isinstance(seed, tuple) else str(seed),
        fingerprint=task.fingerprint,
    )


def fallbacks(tasks: Sequence[Task], folder: Path) -> list[str]:
    """What methods take from elsewhere than this results folder without having been told to: a line each."""
    lines = []
    for task in tasks:
        given = {task.settings.policy, Path(task.settings.model)}
        for artifact in task.artifacts:
            if artifact.path and artifact.path not in given and not artifact.path.is_relative_to(folder):
                what = f"{artifact.kind} {named([artifact], artifact.kind)}"
                lines.append(f"{task.method} {task.regime}: {what} from {artifact.path}")
    return list(dict.fromkeys(lines))
