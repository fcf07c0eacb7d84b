"""Run tasks: resume, workers here or on a cluster, one row each; schedules from any tool likewise.

Of those a folder holds `<instance>.csv` or `<instance>.csv.gz`, meant for every regime, or the same in one
subfolder per regime, which goes first.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.table import LARGEST
from ded_bench.methods.plugin import SLUG
from ded_bench.methods.registry import registered
from ded_bench.methods.solution import Settings, Solution, named
from ded_bench.plants.plant import plant_of
from ded_bench.problem.benchmark import Selection
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results, Row
from ded_bench.run.cluster import Cluster
from ded_bench.run.environment import commit, host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.scoring import scored_row
from ded_bench.run.tasks import Answered, Task, failed, pack, solve_and_score, trace_of
from ded_bench.solvers.status import Status

#: A solve that has not ended so long after its time limit never will, and is killed. It also pays for
#: what comes before the first solve of a process: the building of the model, and once after installing what
#: is compiled, up to a minute of CPU.
GRACE_S = 120.0


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
        InputError: no scheduler answers, or rows were taken away meanwhile.
        WorkersLostError: it answers no more, or its workers cannot run this package.
    """
    todo, plant = unfinished(tasks, results), plant_of(case).name
    with Cluster(scheduler) if scheduler else Workers(workers) as pool, results.packed():
        sent: Iterable[Task] = todo
        if scheduler:  # with the files that answers depend on, read as they are needed
            files = functools.cache(pack)
            sent = (dataclasses.replace(task, files=files(task.artifacts)) for task in todo)
        calls = ((solve_and_score, (case, task, plant)) for task in sent)
        limits = [limit and limit + GRACE_S for limit in (task.settings.time_limit_s for task in todo)]
        with tqdm(total=len(todo), unit="row", disable=None, desc="solve") as bar:
            for task, answer in pool.imap(calls, todo, limits):
                if not isinstance(answer, Answered):  # its worker was lost, or takes too long
                    answer = Answered(failed(answer), None, "" if scheduler else host(), trace_of(answer))
                solution, verdict, where, trace = answer
                row = unscored_row(task, solution, plant, pool.count, problems_version, where)
                row = row if solution.schedule is None else scored_row(row, verdict)
                results.keep(row, solution.schedule, case)
                if trace:
                    results.paths.log_failure(f"{task.method} {task.regime} {task.instance.id}", trace)
                on_row(row)
                bar.set_postfix_str(f"{task.method} {task.regime} {solution.status}")
                bar.update()
    return results.asked(task.key for task in tasks)


def unfinished(tasks: Sequence[Task], results: Results) -> list[Task]:
    """The tasks without a finished row (see `Results.finished`)."""
    return [task for task in tasks if not results.finished(task.key, task.fingerprint, task.version)]


def unscored_row(
    task: Task, solution: Solution, plant: str, workers: int, problems_version: str, where: str
) -> Row:
    """The row of a task with what the solver claims; `where` is the host that solved it."""
    seed, objective = task.instance.seed, solution.solver_objective
    claimed = {name: value for name, value in vars(solution).items() if name != "schedule"}
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


SUFFIXES = (".csv", ".csv.gz")


def submit(
    chosen: Selection, folder: Path, name: str, regimes: Sequence[str], results: Results, workers: int = 1
) -> tuple[list[Row], list[Path]]:
    """Score the schedules of a folder as rows of a method called `name`.

    Every chosen instance gets a row per regime: where its schedule is missing or wrong, a failed one
    that says so. Rows whose schedule is unchanged are not scored again.

    Returns:
        The rows, and the folder's files that no chosen instance asked for.

    Raises:
        InputError: the name is not a plain one or belongs to a method, a regime is unknown, or the
            folder has no schedule for any of the instances.
    """
    if not SLUG.fullmatch(name):
        raise InputError("--name", name, "must be letters, digits, dots, dashes and underscores, at most 64")
    if name in registered():
        raise InputError("--name", name, "is the name of a method; its rows come from `ded-bench solve`")
    chosen.case.check_regimes(regimes)
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder")
    wanted = [(instance, split, regime) for regime in regimes for instance, split in chosen.instances]
    if not wanted:
        raise InputError("--split", "", "holds no instance")
    used = {path for instance, _, regime in wanted for path in _candidates(folder, regime, instance.id)}
    if not used:
        first, _, regime = wanted[0]
        such = f"{first.id}.csv or {regime}/{first.id}.csv"
        raise InputError(folder, "", f"has none of the schedules asked for (such as {such})")
    case, tasks = chosen.case, []
    for instance, split, regime in wanted:
        schedule, content, error = _read(case, folder, instance, regime)
        given = Solution(Status.FAILED if schedule is None else Status.FEASIBLE, schedule, error=error[:300])
        task = Task(instance, split, regime, name, Settings(), given=given)
        tasks.append(task.fingerprinted(case, content))
    rows = run(case, tasks, results, workers, chosen.version)
    places = [folder, *(folder / regime for regime in regimes)]
    found = {path for place in places for suffix in SUFFIXES for path in place.glob(f"*{suffix}")}
    return rows, sorted(found - used)


def _candidates(folder: Path, regime: str, instance: str) -> list[Path]:
    """The files that may be meant for an instance in a regime, those of the regime's own folder first."""
    places = [place / f"{instance}{suffix}" for place in (folder / regime, folder) for suffix in SUFFIXES]
    return [path for path in places if path.is_file()]


def _read(case: Case, folder: Path, instance: Instance, regime: str) -> tuple[Schedule | None, str, str]:
    """A schedule and the hash of its file, or what is wrong with it."""
    found = _candidates(folder, regime, instance.id)
    try:
        if not found:
            raise InputError(folder, f"{instance.id}.csv", "no such schedule in the folder")
        if len(found) > 1 and found[0].parent == found[1].parent:
            raise InputError(found[0], "", f"is one of two, beside {found[1].name}")
        schedule = Schedule.read(found[0], case, instance.horizon_s)
        return schedule, hashlib.sha256(found[0].read_bytes()).hexdigest(), ""
    except InputError as wrong:
        return None, "", str(wrong)
