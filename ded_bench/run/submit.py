"""Schedules from any tool: a folder of CSV files becomes rows of the results table, scored like ours.

The folder holds `<instance>.csv` or `<instance>.csv.gz`, meant for every regime, or the same in one
subfolder per regime, which goes first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ded_bench.files.errors import InputError
from ded_bench.methods.plugin import SLUG
from ded_bench.methods.registry import registered
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import plant_of
from ded_bench.problem.benchmark import Selection
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results, Row
from ded_bench.run.environment import host
from ded_bench.run.pool import Workers
from ded_bench.run.runner import unscored_row
from ded_bench.run.scoring import scored_row, verdicts
from ded_bench.run.tasks import Task, fingerprint_of, key_of
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
    case, plant, keys, sound = chosen.case, plant_of(chosen.case).name, [], []
    for instance, split, regime in wanted:
        schedule, content, error = _read(case, folder, instance, regime)
        key = key_of(instance, regime, name, Settings(), ())
        fingerprint = fingerprint_of(case, instance, key, content)
        keys.append(key)
        if not results.finished(key, fingerprint):
            task = Task(instance, split, regime, name, Settings(), fingerprint)
            answer = Solution(Status.FAILED if schedule is None else Status.FEASIBLE, error=error[:300])
            row = unscored_row(task, answer, plant, workers, chosen.version, host())
            results.keep(row, schedule, case)
            sound += [row] if schedule is not None else []
    with Workers(workers) as pool, results.packed():
        instances = {instance.id: instance for instance, _ in chosen.instances}
        results.add(scored_row(*judged) for judged in verdicts(case, sound, instances, results, pool))
    places = [folder, *(folder / regime for regime in regimes)]
    found = {path for place in places for suffix in SUFFIXES for path in place.glob(f"*{suffix}")}
    return Submission([results.rows[key] for key in keys], sorted(found - used))


def _check_name(name: str) -> None:
    if not SLUG.fullmatch(name):
        raise InputError("--name", name, "must be letters, digits, dots, dashes and underscores, at most 64")
    if name in registered():
        raise InputError("--name", name, "is the name of a method; its rows come from `ded-bench solve`")


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
