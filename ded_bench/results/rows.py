"""The results table of a folder: one row per (instance, regime, method, settings)."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Table, cell, plain_name
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import ResultsFolder
from ded_bench.solvers.status import Status

if TYPE_CHECKING:
    import pandas as pd


#: How the error of a row begins whose schedule the scorer cannot simulate.
SCORING_FAILED = "scoring failed: "


class Key(NamedTuple):
    """What makes a row unique."""

    instance: str
    regime: str
    method: str
    settings: str


@dataclass(frozen=True)
class Row:
    """One result. `status` is the solver's claim; objective and violations are re-simulated.

    Units are in the names; ramp, bound and initial violations are in pu. `model` and `policy` are
    `name@fingerprint` of what shaped the answer, `code` and `score_code` say which sources computed the
    answer and its score (see `run.code`). A row is valid for a task of the same `fingerprint`.
    """

    instance: str = cell(check=plain_name)
    split: str = cell()
    regime: str = cell(check=plain_name)
    method: str = cell(check=plain_name)
    settings: str = cell(check=plain_name)
    status: str = cell(check=lambda text: str(Status(text)))
    iterations: int | None = None
    build_s: float | None = None
    setup_s: float | None = None
    solve_s: float | None = None
    solver_objective: float | None = None
    objective: float | None = None
    freq_violation_hz: float | None = None
    ramp_violation: float | None = None
    bound_violation: float | None = None
    initial_violation: float | None = None
    feasible: bool | None = None
    feasible_strict: bool | None = None
    error: str = ""
    workers: int = 1
    problems_version: str = ""
    version: str = ""
    solver_version: str = ""
    host: str = ""
    date: str = ""
    case: str = ""
    seed: str = ""
    fingerprint: str = ""
    time_limit_s: float | None = None
    model: str = ""
    policy: str = ""
    code: str = ""
    score_code: str = ""

    @property
    def key(self) -> Key:
        """The row's place in the table."""
        return Key(self.instance, self.regime, self.method, self.settings)

    @property
    def scored(self) -> bool:
        """The scorer has spoken, or has failed and said why."""
        return self.objective is not None or self.error.startswith(SCORING_FAILED)


ROWS = Table(Row)


class Results(KeyedTable[Key, Row]):
    """The results table of a folder, and the schedules beside it.

    Raises:
        InputError: there is a table, but it is wrong.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.paths = ResultsFolder(self.folder)
        super().__init__(self.paths.results, ROWS)

    def has(self, key: Key, fingerprint: str) -> bool:
        """Whether a row is finished: same fingerprint, and scored.

        One without an objective, for which scoring has failed, needs its schedule as well. Others are
        finished without: a published folder keeps a part of its schedules only.
        """
        if not self.made_from(key, fingerprint):
            return False
        row = self.rows[key]
        return row.objective is not None or (row.scored and self.schedule_path(key).is_file())

    def solved(self, key: Key, fingerprint: str) -> bool:
        """Whether a schedule for this row is on disk, scored or not."""
        return self.made_from(key, fingerprint) and self.schedule_path(key).is_file()

    def schedule_path(self, key: Key) -> Path:
        """Where the schedule of a row is kept."""
        return self.paths.schedule(key.method, key.settings, key.regime, key.instance)

    def schedule(self, key: Key, case: Case, instance: Instance) -> Schedule:
        """Read the schedule of a row; InputError if it is missing or wrong."""
        return Schedule.read(self.schedule_path(key), case, instance.horizon_s)

    def kept(self, instances: Container[str]) -> list[Row]:
        """The rows of some instances, by id, whose schedules are kept.

        Raises:
            InputError: there is none.
        """
        known = [row for row in self.rows.values() if row.instance in instances]
        kept = [row for row in known if self.schedule_path(row.key).is_file()]
        if not kept:
            raise InputError(self.paths.schedules, "", "holds no schedule of these rows")
        return kept

    def frame(self) -> pd.DataFrame:
        """The table, one row each, typed columns; empty cells are missing values."""
        return ROWS.frame(self.rows.values())
