"""Scores of kept schedules: rows are scored, or those of a results folder scored again and compared."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.table import LARGEST
from ded_bench.methods.solution import Settings
from ded_bench.plants import score as score_module
from ded_bench.plants.score import Score, score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import SCORING_FAILED, Results, Row
from ded_bench.run.code import code_of
from ded_bench.run.pool import Workers
from ded_bench.run.tasks import Scorer, Task, reason_of, score_tasks

#: Schedules scored side by side in one task; more gains little, fewer costs overhead.
SCORE_BATCH = 50
#: What a kept schedule, scored again, may differ by from its row.
OBJECTIVE_RELATIVE, VIOLATION_HZ, VIOLATION_PU = 1e-9, 1e-9, 1e-9
_POWER_LIMITS = ("ramp_violation", "bound_violation", "initial_violation")


@dataclass(frozen=True)
class Check:
    """What was found when the kept schedules of a results folder were scored again.

    Attributes:
        rows: those that were compared, as they are scored now.
        differences: one sentence each.
        without_schedule: rows whose schedule is not kept.
        unscored: rows with a schedule, but no score yet.
        unknown: rows of instances that are not among those given.
    """

    rows: list[Row]
    differences: list[str]
    without_schedule: int
    unscored: int
    unknown: int


def score_schedules(
    case: Case, tasks: Sequence[Task], results: Results, pool: Workers, scorer: Scorer = score
) -> Iterator[tuple[list[Task], list[object]]]:
    """Score the kept schedules of tasks, batch by batch; a schedule that cannot be read has an InputError."""
    batches = list(_batches(tasks))
    with tqdm(total=len(tasks), unit="row", disable=None, desc="score") as bar:
        wrong: dict[int, InputError] = {}

        def read(batch: Sequence[Task]) -> tuple[list[Task], list[Schedule]]:
            sound = []
            for task in batch:
                try:
                    sound.append((task, results.schedule(task.key, case, task.instance)))
                except InputError as error:
                    wrong[id(task)] = error
            return [task for task, _ in sound], [schedule for _, schedule in sound]

        calls = ((score_tasks, (case, *read(batch), scorer)) for batch in batches)  # read as they are needed
        for batch, answer in pool.imap(calls, batches):
            verdicts = iter(answer) if isinstance(answer, list) else None
            yield (
                batch,
                [wrong.get(id(task)) or (answer if verdicts is None else next(verdicts)) for task in batch],
            )
            bar.update(len(batch))


def scored_row(row: Row, verdict: object) -> Row:
    """A row with the scorer's verdict filled in, or with the reason why there is none."""
    return dataclasses.replace(without_score(row), **score_cells(verdict, code_of(score_module.__name__)))


def score_cells(verdict: object, code: str) -> dict[str, Any]:
    """What a verdict says as the cells of a row, or the error that says why there is none.

    Args:
        verdict: a Score, or anything else for a schedule that could not be scored.
        code: of the scorer.
    """
    if not isinstance(verdict, Score):
        return {"error": f"{SCORING_FAILED}{reason_of(verdict)}"}
    numbers = dataclasses.asdict(verdict)
    if not all(abs(value) <= LARGEST for value in numbers.values()):
        return {"error": f"{SCORING_FAILED}cost or violations are above {LARGEST:g}"}
    feasible = {"feasible": verdict.feasible, "feasible_strict": verdict.feasible_strict}
    return numbers | feasible | {"score_code": code}


def without_score(row: Row) -> Row:
    """A row as it was before it was scored."""
    names = (field.name for field in dataclasses.fields(Score))
    empty = dict.fromkeys((*names, "feasible", "feasible_strict"))
    error = "" if row.error.startswith(SCORING_FAILED) else row.error
    return dataclasses.replace(row, error=error, score_code="", **empty)  # type: ignore[arg-type]


def save_scores(
    case: Case,
    tasks: Sequence[Task],
    results: Results,
    pool: Workers,
    on_row: Callable[[Row], None] = lambda row: None,
) -> None:
    """Score the kept schedules of tasks and fill in their rows.

    Raises:
        InputError: a kept schedule is damaged, which is the user's to remove.
    """
    for batch, verdicts in score_schedules(case, tasks, results, pool):
        for verdict in verdicts:
            if isinstance(verdict, InputError):
                raise verdict
        rows = [scored_row(results.rows[t.key], v) for t, v in zip(batch, verdicts, strict=True)]
        results.add(rows)
        for row in rows:
            on_row(row)


def score_unscored(
    case: Case, instances: Mapping[str, Instance], results: Results, pool: Workers
) -> tuple[Row, ...]:
    """Score the kept schedules that have no score yet, as after an interruption; returns their rows.

    Args:
        instances: by id; rows of others stay as they are.

    Raises:
        InputError: a kept schedule is damaged.
    """
    waiting = [row for row in results.rows.values() if not row.scored and row.instance in instances]
    waiting = [row for row in waiting if results.schedule_path(row.key).is_file()]
    save_scores(case, tasks_of(waiting, instances), results, pool)
    return tuple(results.rows[row.key] for row in waiting)


def rescore(
    case: Case,
    instances: Mapping[str, Instance],
    results: Results,
    workers: int = 1,
    *,
    update: bool = False,
    on_difference: Callable[[str], None] = lambda sentence: None,
) -> Check:
    """Score the kept schedules of a results folder again, and compare with its rows.

    Args:
        instances: by id; rows of others are counted.
        update: write the new scores into the rows.

    Raises:
        InputError: none of the rows' schedules is kept.
    """
    kept = results.kept(instances)
    tasks = tasks_of(kept if update else [row for row in kept if row.scored], instances)
    rows, differences = [], []
    with Workers(workers) as pool:
        for batch, verdicts in score_schedules(case, tasks, results, pool):
            pairs = [
                (row, scored_row(row, verdict))
                for row, verdict in zip((results.rows[task.key] for task in batch), verdicts, strict=True)
            ]
            for old, new in pairs:
                for sentence in _differences(old, new) if old.scored else ():
                    differences.append(f"{old.method} {old.settings} {old.regime} {old.instance}: {sentence}")
                    on_difference(differences[-1])
            rows += [new for _, new in pairs]
            if update:
                results.add(new for _, new in pairs)
    if update:
        results.compact()
    unknown = sum(row.instance not in instances for row in results.rows.values())
    return Check(
        rows,
        differences,
        without_schedule=len(results.rows) - unknown - len(kept),
        unscored=sum(not row.scored for row in kept) if not update else 0,
        unknown=unknown,
    )


def tasks_of(rows: Iterable[Row], instances: Mapping[str, Instance]) -> list[Task]:
    """Rows whose schedules are kept, as tasks to be scored."""
    return [
        Task(instances[row.instance], row.split, row.regime, row.method, Settings(row.settings), "")
        for row in rows
    ]


def _differences(old: Row, new: Row) -> Iterator[str]:
    """What a row says and its schedule, scored again, does not."""
    if (old.objective is None) != (new.objective is None) or old.objective is None or new.objective is None:
        if old.objective is not None:
            yield new.error
        elif new.objective is not None:
            yield f"the row has no score ({old.error}), but the schedule has"
        return
    if not math.isclose(old.objective, new.objective, rel_tol=OBJECTIVE_RELATIVE):
        yield f"objective {old.objective!r} in the row, {new.objective!r} scored again"
    tolerances = {"freq_violation_hz": VIOLATION_HZ, **dict.fromkeys(_POWER_LIMITS, VIOLATION_PU)}
    missing = [name for name in tolerances if getattr(old, name) is None]
    yield from (f"{name} is missing in the row" for name in missing)
    if missing:
        return
    for name, tolerance in tolerances.items():
        was, is_now = getattr(old, name), getattr(new, name)
        if abs(was - is_now) > tolerance:
            yield f"{name} {was!r} in the row, {is_now!r} scored again"
    own = Score(**{field.name: getattr(old, field.name) for field in dataclasses.fields(Score)})
    if (old.feasible, old.feasible_strict) != (own.feasible, own.feasible_strict):
        yield "feasible or feasible_strict do not follow from the row's own violations"


def _batches(tasks: Iterable[Task]) -> Iterator[list[Task]]:
    """Tasks to be simulated side by side: of one grid, and of one method, whose schedules bend alike."""
    groups: dict[tuple[int, float, str], list[Task]] = {}
    for task in tasks:
        groups.setdefault((task.instance.steps, task.instance.dt_s, task.method), []).append(task)
    for group in groups.values():
        for start in range(0, len(group), SCORE_BATCH):
            yield group[start : start + SCORE_BATCH]
