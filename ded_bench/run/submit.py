"""Schedules from any tool: a folder of CSV files becomes rows of the results table, scored like ours.

The folder holds `<instance>.csv` or `<instance>.csv.gz`, meant for every regime, or the same in one
subfolder per regime, which goes first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ded_bench.files.errors import InputError
from ded_bench.methods.plugin import SLUG
from ded_bench.methods.registry import registered
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.benchmark import Selection
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results, Row
from ded_bench.run.environment import host
from ded_bench.run.runner import run, unscored_row
from ded_bench.run.tasks import Task
from ded_bench.solvers.status import Status

SUFFIXES = (".csv", ".csv.gz")


@dataclass(frozen=True)
class Submission:
    """The rows of a folder of schedules, and its files that no chosen instance asked for."""

    rows: list[Row]
    unused: list[Path]


def submit(
    chosen: Selection,
    folder: Path,
    name: str,
    regimes: Sequence[str],
    results: Results,
    workers: int = 1,
    on_row: Callable[[Row], None] = lambda row: None,
) -> Submission:
    """Score the schedules of a folder as rows of a method called `name`.

    Every chosen instance gets a row per regime: where its schedule is missing or wrong, a failed one
    that says so. Rows whose schedule is unchanged are not scored again.

    Raises:
        InputError: the name is not a plain one or belongs to a method, a regime is unknown, or the
            folder has no schedule for any of the instances.
    """
    _check_name(name)
    chosen.case.check_regimes(regimes)
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder")
    wanted = [(instance, split, regime) for regime in regimes for instance, split in chosen.instances]
    used = {path for instance, _, regime in wanted for path in _candidates(folder, regime, instance.id)}
    if not used:
        first, _, regime = wanted[0]
        such = f"{first.id}.csv or {regime}/{first.id}.csv"
        raise InputError(folder, "", f"has none of the schedules asked for (such as {such})")
    tasks, fresh, to_score = [], [], []
    for instance, split, regime in wanted:
        task, schedule, error = _read(chosen.case, folder, name, instance, split, regime)
        tasks.append(task)
        path = results.schedule_path(task.key)
        if schedule is None:
            path.unlink(missing_ok=True)  # an earlier submission's
            fresh.append(_row(task, Status.FAILED, error, workers, chosen.version))
            on_row(fresh[-1])
            continue
        to_score.append(task)
        if not results.solved(task.key, task.fingerprint):
            schedule.write(path, chosen.case.generators)
            fresh.append(_row(task, Status.FEASIBLE, "", workers, chosen.version))
    results.add(fresh)
    run(chosen.case, to_score, results, workers, chosen.version, on_row)  # solved already: only scored
    places = [folder, *(folder / regime for regime in regimes)]
    found = {path for place in places for suffix in SUFFIXES for path in place.glob(f"*{suffix}")}
    return Submission([results.rows[task.key] for task in tasks], sorted(found - used))


def _check_name(name: str) -> None:
    if not SLUG.fullmatch(name):
        raise InputError("--name", name, "must be letters, digits, dots, dashes and underscores, at most 64")
    if name in registered():
        raise InputError("--name", name, "is the name of a method; its rows come from `ded-bench solve`")


def _candidates(folder: Path, regime: str, instance: str) -> list[Path]:
    """The files that may be meant for an instance in a regime, those of the regime's own folder first."""
    places = [place / f"{instance}{suffix}" for place in (folder / regime, folder) for suffix in SUFFIXES]
    return [path for path in places if path.is_file()]


def _read(
    case: Case, folder: Path, name: str, instance: Instance, split: str, regime: str
) -> tuple[Task, Schedule | None, str]:
    """A task with the fingerprint of its file's content, and the schedule or what is wrong with it."""
    found = _candidates(folder, regime, instance.id)
    content, schedule, error = b"", None, ""
    try:
        if not found:
            raise InputError(folder, f"{instance.id}.csv", "no such schedule in the folder")
        if len(found) > 1 and found[0].parent == found[1].parent:
            raise InputError(found[0], "", f"is one of two, beside {found[1].name}")
        schedule = Schedule.read(found[0], case, instance.horizon_s)
        content = found[0].read_bytes()
    except InputError as wrong:
        error = str(wrong)
    parts = (case.fingerprint, instance.fingerprint, regime, name, hashlib.sha256(content).hexdigest())
    fingerprint = hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
    return Task(instance, split, regime, name, Settings(), fingerprint), schedule, error


def _row(task: Task, status: Status, error: str, workers: int, problems_version: str) -> Row:
    return unscored_row(task, Solution(status, error=error[:300]), workers, problems_version, host())
