"""Kept schedules on the full AC network: a table beside the results, one row for each of theirs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import LARGEST, Table, cell, plain_name
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.code import code_of
from ded_bench.run.pool import Workers
from ded_bench.run.results import Key, Results, Row
from ded_bench.run.scoring import FAILED, SCORE_BATCH
from ded_bench.run.tasks import reason_of
from ded_bench.truth import ac_simulate
from ded_bench.truth.ac_simulate import score_ac
from ded_bench.truth.score import Score
from ded_bench.truth.simulate import SimulationError

#: The table's name in a results folder.
FILE = "ac.csv"


@dataclass(frozen=True)
class AcRow:
    """What the scorer says about a row's schedule on the AC network; units as in `run.results.Row`.

    `fingerprint` is that of the row whose schedule it is, `data` that of the AC data, `score_code` says
    which sources computed the score.
    """

    instance: str = cell(check=plain_name)
    regime: str = cell(check=plain_name)
    method: str = cell(check=plain_name)
    settings: str = cell(check=plain_name)
    objective: float | None = None
    freq_violation_hz: float | None = None
    ramp_violation: float | None = None
    bound_violation: float | None = None
    initial_violation: float | None = None
    feasible: bool | None = None
    feasible_strict: bool | None = None
    error: str = ""
    case: str = ""
    fingerprint: str = ""
    data: str = ""
    score_code: str = ""

    @property
    def key(self) -> Key:
        """The key of the row in the results."""
        return Key(self.instance, self.regime, self.method, self.settings)


AC_ROWS = Table(AcRow)


class AcResults(KeyedTable[Key, AcRow]):
    """The rows of a results folder on the AC network; InputError if there is a table, but a wrong one."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__(Path(folder) / FILE, AC_ROWS, lambda row: row.key)


def score_on_ac(
    case: Case, data: AcCase, instances: Mapping[str, Instance], results: Results, workers: int = 1
) -> tuple[Path, list[AcRow]]:
    """Score the kept schedules of a results folder on the AC network, and save the rows.

    Args:
        case: the grid.
        data: its AC data.
        instances: by id; rows of others are passed over.
        results: the folder.
        workers: processes.

    Returns:
        The table, and the rows that were made.

    Raises:
        InputError: none of the rows' schedules is kept, or case and data do not fit together.
    """
    data.machines_of(case)
    known = [row for row in results.rows.values() if row.instance in instances]
    kept = [row for row in known if results.schedule_path(row.key).is_file()]
    if not kept:
        raise InputError(results.paths.schedules, "", "holds no schedule of these rows")
    table, made = AcResults(results.folder), []
    batches = [kept[start : start + SCORE_BATCH] for start in range(0, len(kept), SCORE_BATCH)]
    calls = (
        (_score_batch, (case, data, [_problem(row, case, instances, results) for row in batch]))
        for batch in batches
    )
    with Workers(workers) as pool, tqdm(total=len(kept), unit="row", disable=None, desc="score") as bar:
        for batch, answer in pool.imap(calls, batches):
            verdicts = answer if isinstance(answer, list) else [answer] * len(batch)
            rows = [_row(row, data, verdict) for row, verdict in zip(batch, verdicts, strict=True)]
            table.add(rows)
            made += rows
            bar.update(len(batch))
    table.compact()
    return table.path, made


Problem = tuple[Instance, Schedule, str]


def _problem(
    row: Row, case: Case, instances: Mapping[str, Instance], results: Results
) -> Problem | InputError:
    """What is to be scored, or why it cannot be read."""
    instance = instances[row.instance]
    try:
        return instance, results.schedule(row.key, case, instance), row.regime
    except InputError as error:
        return error


def _score_batch(
    case: Case, data: AcCase, problems: Sequence[Problem | InputError]
) -> list[Score | SimulationError | InputError]:
    verdicts: list[Score | SimulationError | InputError] = []
    for problem in problems:
        try:
            verdicts.append(problem if isinstance(problem, InputError) else score_ac(case, data, *problem))
        except SimulationError as error:
            verdicts.append(error)
    return verdicts


def _row(row: Row, data: AcCase, verdict: object) -> AcRow:
    made = AcRow(*row.key, case=row.case, fingerprint=row.fingerprint, data=data.fingerprint)
    if not isinstance(verdict, Score):
        return dataclasses.replace(made, error=f"{FAILED}{reason_of(verdict)}")
    numbers = dataclasses.asdict(verdict)
    if not all(abs(value) <= LARGEST for value in numbers.values()):
        return dataclasses.replace(made, error=f"{FAILED}cost or violations are above {LARGEST:g}")
    return dataclasses.replace(
        made,
        feasible=verdict.feasible,
        feasible_strict=verdict.feasible_strict,
        score_code=code_of(ac_simulate.__name__),
        **numbers,
    )
