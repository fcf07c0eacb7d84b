"""Kept schedules on the full AC network: a table beside the results, one row for each of theirs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Table, cell, plain_name
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.run.code import code_of
from ded_bench.run.pool import Workers
from ded_bench.run.results import Key, Results, Row
from ded_bench.run.scoring import score_cells, score_schedules, tasks_of
from ded_bench.truth import ac_simulate
from ded_bench.truth.ac_simulate import score_ac

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
        super().__init__(Path(folder) / FILE, AC_ROWS)


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
    tasks = tasks_of(results.kept(instances), instances)
    table, made = AcResults(results.folder), []
    with Workers(workers) as pool:
        for batch, verdicts in score_schedules(case, tasks, results, pool, partial(score_ac, data=data)):
            rows = [
                _row(results.rows[task.key], data, verdict)
                for task, verdict in zip(batch, verdicts, strict=True)
            ]
            table.add(rows)
            made += rows
    table.compact()
    return table.path, made


def _row(row: Row, data: AcCase, verdict: object) -> AcRow:
    cells = score_cells(verdict, code_of(ac_simulate.__name__))
    return AcRow(*row.key, case=row.case, fingerprint=row.fingerprint, data=data.fingerprint, **cells)
