"""The results table of a folder: one row per instance, regime, method and what the method was run with."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from pydantic import AfterValidator

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable, locked
from ded_bench.files.table import NotNegative, PlainName, Table
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.archive import Archive
from ded_bench.results.folder import ResultsFolder, reference_run
from ded_bench.results.legacy import upgraded
from ded_bench.solvers.status import Status

if TYPE_CHECKING:
    import pandas as pd


#: How the error of a row begins whose schedule the scorer cannot simulate.
SCORING_FAILED = "scoring failed: "


class Key(NamedTuple):
    """What makes a row unique. `model` and `policy` are `name@fingerprint`, or empty."""

    case: str
    instance: str
    regime: str
    method: str
    settings: str
    model: str = ""
    policy: str = ""
    time_limit_s: float | None = None


_Claim = Annotated[str, AfterValidator(lambda text: str(Status(text)))]


@dataclass(frozen=True, kw_only=True)
class Made:
    """What made a row, where and when; `method_version` is the method's then."""

    case: str = ""
    version: str = ""
    commit: str = ""
    method_version: int = 0
    host: str = ""
    date: str = ""


@dataclass(frozen=True, kw_only=True)
class OfIslands:
    """Numbers of islands alone, as the scorer names and defines them (`Score`)."""

    mean_freq_rms_hz: NotNegative | None = None
    mean_freq_max_hz: NotNegative | None = None
    swing_rms_hz: NotNegative | None = None
    swing_max_hz: NotNegative | None = None
    excess_mean_hz: NotNegative | None = None
    excess_relative_hz: NotNegative | None = None
    excess_end_hz: NotNegative | None = None
    agc_travel_pu: NotNegative | None = None


@dataclass(frozen=True)
class Row(OfIslands, Made):
    """One result. `status` is the solver's claim; objective and violations are re-simulated on `plant`.

    Units are in the names; ramp, bound and initial violations are in pu. `settings` is the canonical text of
    the method's options. A row is valid for a task of the same `fingerprint`.
    """

    instance: PlainName
    split: str
    regime: PlainName
    method: PlainName
    settings: PlainName
    status: _Claim
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
    solver_version: str = ""
    seed: str = ""
    fingerprint: PlainName = ""
    time_limit_s: float | None = None
    model: str = ""
    policy: str = ""
    plant: str = "lossless"

    @property
    def key(self) -> Key:
        """The row's place in the table."""
        return Key(*(getattr(self, name) for name in Key._fields))

    @property
    def member(self) -> str:
        """What the row's schedule is called in its archive."""
        return f"{self.instance}-{self.fingerprint}"


class ValidatedRow(Row):
    """A row whose kept schedule was judged on another plant, `plant`."""

    @property
    def key(self) -> tuple[Key, str]:  # type: ignore[override]  # rows of several plants share a table
        """The row's place in the table."""
        return super().key, self.plant


def differences(before: Row, after: Row, limits: Mapping[str, float]) -> dict[str, float]:
    """How far two rows are apart, by column, where that is beyond a limit.

    Distances of objectives are relative; what are no two numbers is infinitely far apart.
    """
    found = {}
    for column, limit in limits.items():
        x, y = getattr(before, column), getattr(after, column)
        apart = 0.0 if x == y else math.inf
        if apart and isinstance(x, float) and isinstance(y, float):
            apart = abs(y - x) / (max(abs(x), abs(y)) if column == "objective" else 1.0)
        if apart > limit:
            found[column] = apart
    return found


ROWS = Table(Row, since="method_version", upgrade=upgraded)
VALIDATED = Table(ValidatedRow)


class Results(KeyedTable[Key, Row]):
    """The results table of a folder, and the schedules beside it.

    Raises:
        InputError: there is a table, but it is wrong.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.paths = ResultsFolder(self.folder)
        self._archives: dict[Path, Archive] = {}
        super().__init__(self.paths.results, ROWS)

    def finished(self, key: Key, fingerprint: str, version: int = 0) -> bool:
        """Whether a row is there: same fingerprint, not of an older version of the method, and scored.

        One without an objective, for which scoring has failed, needs its schedule as well. Others are
        finished without: a published folder keeps a part of its schedules only.
        """
        if not self.made_from(key, fingerprint, version):
            return False
        row = self.rows[key]
        return row.objective is not None or (row.error.startswith(SCORING_FAILED) and self.has_schedule(row))

    def archive(self, row: Row) -> Archive:
        """Where the schedule of a row is kept."""
        path = self.paths.archive(row.method, row.settings, row.regime)
        return self._archives.setdefault(path, Archive(path))

    def has_schedule(self, row: Row) -> bool:
        """Whether the schedule of a row is kept; InputError if its archive is damaged."""
        return row.member in self.archive(row)

    def schedule(self, row: Row, case: Case, instance: Instance) -> Schedule:
        """Read the schedule of a row; InputError if it is missing or wrong."""
        return self.archive(row).read(row.member, case, instance.horizon_s)

    def keep(self, row: Row, schedule: Schedule | None, case: Case) -> None:
        """Save a row and its schedule, which comes first: one without a row is no loss.

        A row that has no schedule takes away what an earlier one of its key has left.
        """
        archive, before = self.archive(row), self.rows.get(row.key, row)
        if schedule is not None:
            archive.write(row.member, schedule, case)
        elif left := [name for name in (row.member, before.member) if name in archive]:
            with locked(self.folder):
                archive.drop(left)
        self.add([row])

    def kept(self, instances: Container[str]) -> list[Row]:
        """The rows of some instances, by id, whose schedules are kept.

        Raises:
            InputError: there is none.
        """
        kept = [row for row in self.rows.values() if row.instance in instances and self.has_schedule(row)]
        if not kept:
            known = any(row.instance in instances for row in self.rows.values())
            whose = "these rows" if known else "instances that are known here; name them by --instance"
            raise InputError(self.paths.schedules, "", f"holds no schedule of {whose}")
        return kept

    def pack(self) -> None:
        """Move schedules that are saved one by one into their archives, and drop those of replaced rows."""
        if not any(self.paths.schedules.glob("*/*/*/*.npy")):
            return
        with locked(self.folder):
            self.reload()
            members: dict[Archive, set[str]] = {}
            for row in self.rows.values():
                members.setdefault(self.archive(row), set()).add(row.member)
            for archive, named in members.items():
                archive.pack(named)

    @contextlib.contextmanager
    def packed(self) -> Iterator[None]:
        """Pack schedules before and after a block, and leave one line per row, also if it is interrupted."""
        self.pack()
        try:
            yield
        finally:
            self.pack()
            self.compact()

    def frame(self) -> pd.DataFrame:
        """The table, one row each, typed columns; empty cells are missing values."""
        return ROWS.frame(self.rows.values())


@dataclass(frozen=True)
class Objective:
    """The re-simulated objective of one method in its default settings; comparable within one version."""

    case: str
    instance: str
    regime: str
    method: str
    objective: float
    problems_version: str = ""


OBJECTIVES = Table(Objective)


def objectives_of(rows: Iterable[Row]) -> list[Objective]:
    """The scored rows with default settings and nothing trained, by regime, method and instance.

    Of rows that differ in their time limits the newest counts.
    """
    found = {
        (row.regime, row.method, row.instance, row.case): Objective(
            row.case, row.instance, row.regime, row.method, row.objective, row.problems_version
        )
        for row in sorted(rows, key=lambda row: row.date)
        if row.objective is not None
        and row.settings == "default"
        and not (row.model or row.policy)
        and row.split != "validation"  # their rows serve choices, not comparisons
    }
    return [found[place] for place in sorted(found)]


def reference_objectives(case: Case) -> list[Objective]:
    """The objectives of a case's reference run; empty where it has none.

    Raises:
        InputError: the table is wrong.
    """
    return OBJECTIVES.existing(ResultsFolder(reference_run(case)).objectives)
