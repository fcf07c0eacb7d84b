"""Scores of kept schedules: rows are scored, scored again and compared, or judged on another plant."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import LARGEST
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import Score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import SCORING_FAILED, VALIDATED, Key, Results, Row, ValidatedRow, differences
from ded_bench.run.pool import Workers
from ded_bench.run.tasks import Question, reason_of, score_all

#: Schedules scored in one call of a worker, which costs some milliseconds.
BATCH = 50
_SCORE = tuple(field.name for field in dataclasses.fields(Score))
#: What a kept schedule, scored again, may differ by from its row, in parts of the objective, Hz and pu.
SAME = dict.fromkeys(_SCORE, 1e-9)

#: What a kept schedule is worth, or why that cannot be told.
Verdict = Score | Exception


def verdicts(
    case: Case, instances: Mapping[str, Instance], results: Results, workers: int, plant: str = ""
) -> Iterator[tuple[Row, Verdict]]:
    """Score all kept schedules, in any order, on the plant of each row unless another is named.

    A schedule that cannot be read has an InputError, one that its plant cannot follow a SimulationError.

    Raises:
        InputError: none is kept.
    """
    rows = results.kept(instances)

    def question(row: Row) -> Question:
        instance = instances[row.instance]
        try:
            schedule: Schedule | InputError = results.schedule(row, case, instance)
        except InputError as error:
            schedule = error
        return instance, schedule, row.regime, plant or row.plant

    batches = [rows[start : start + BATCH] for start in range(0, len(rows), BATCH)]
    calls = ((score_all, (case, list(map(question, batch)))) for batch in batches)  # read as they are needed
    with Workers(workers) as pool, tqdm(total=len(rows), unit="row", disable=None, desc="score") as bar:
        for batch, answer in pool.imap(calls, batches):
            found: list[Any] = answer if isinstance(answer, list) else [answer] * len(batch)
            yield from zip(batch, found, strict=True)
            bar.update(len(batch))


def scored_row(row: Row, verdict: object) -> Row:
    """A row with the scorer's verdict filled in, or with the reason why there is none."""
    cells: dict[str, Any] = dict.fromkeys((*_SCORE, "feasible", "feasible_strict"))
    cells["error"] = "" if row.error.startswith(SCORING_FAILED) else row.error
    if not isinstance(verdict, Score):
        cells["error"] = f"{SCORING_FAILED}{reason_of(verdict)}"
    elif not all(value is None or abs(value) <= LARGEST for value in dataclasses.astuple(verdict)):
        cells["error"] = f"{SCORING_FAILED}cost or violations are above {LARGEST:g}"
    else:
        judged = {"feasible": verdict.feasible, "feasible_strict": verdict.feasible_strict}
        cells |= dataclasses.asdict(verdict) | judged
    return dataclasses.replace(row, **cells)


def rescore(
    case: Case,
    instances: Mapping[str, Instance],
    results: Results,
    workers: int = 1,
    *,
    update: bool = False,
    on_difference: Callable[[str], None] = lambda sentence: None,
) -> tuple[list[Row], list[str]]:
    """Score the kept schedules of a results folder again, and compare with its rows.

    Args:
        case: of the rows.
        instances: by id; rows of others are passed over.
        results: the folder's.
        workers: processes.
        update: write the new scores into the rows.
        on_difference: called with each sentence.

    Returns:
        The rows that were compared, as they are scored now, and their differences, a sentence each.

    Raises:
        InputError: none of the rows' schedules is kept.
    """
    rows, found, sound = [], [], []
    for old, verdict in verdicts(case, instances, results, workers):
        rows.append(scored_row(old, verdict))
        if isinstance(verdict, Score | SimulationError):  # no worker that died, no damaged file
            sound.append(rows[-1])
        for sentence in _differences(old, rows[-1]):
            found.append(f"{old.method} {old.settings} {old.regime} {old.instance}: {sentence}")
            on_difference(found[-1])
    if update:
        results.add(sound)
        results.compact()
    return rows, found


def validate(
    case: Case, instances: Mapping[str, Instance], results: Results, plant: str, workers: int = 1
) -> list[ValidatedRow]:
    """Score the kept schedules of a results folder on another plant, and save that in `validated.csv`.

    Raises:
        InputError: none of the rows' schedules is kept.
    """
    table: KeyedTable[tuple[Key, str], ValidatedRow] = KeyedTable(results.paths.validated, VALIDATED)
    rows = []
    for row, verdict in verdicts(case, instances, results, workers, plant):
        rows.append(ValidatedRow(**vars(scored_row(dataclasses.replace(row, plant=plant), verdict))))
        if isinstance(verdict, Score | SimulationError) or rows[-1].key not in table.rows:
            table.add(rows[-1:])
    table.compact()
    return rows


def _differences(old: Row, new: Row) -> Iterator[str]:
    """What a row says and its schedule, scored again, does not."""
    for name, apart in differences(old, new, SAME).items():
        why = f" ({old.error or new.error})" if math.isinf(apart) else ""
        yield f"{name} {getattr(old, name)!r} in the row, {getattr(new, name)!r} scored again{why}"
        if math.isinf(apart):
            return
    if old.objective is not None and new.objective is not None:
        own = Score(**{name: getattr(old, name) for name in _SCORE})
        if (old.feasible, old.feasible_strict) != (own.feasible, own.feasible_strict):
            yield "feasible or feasible_strict do not follow from the row's own violations"
