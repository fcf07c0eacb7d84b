"""The results table on disk: one row per (instance, regime, method, settings), saved atomically."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import fcntl
import functools
import io
import operator
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_text, write_atomically
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status


class Key(NamedTuple):
    """What makes a row unique."""

    instance: str
    regime: str
    method: str
    settings: str


@dataclass(frozen=True)
class Row:
    """One result. `status` is the solver's claim; objective and violations are re-simulated."""

    instance: str
    split: str
    regime: str
    method: str
    settings: str
    status: str
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

    @property
    def key(self) -> Key:
        """The row's place in the table."""
        return Key(self.instance, self.regime, self.method, self.settings)

    @property
    def scored(self) -> bool:
        """The scorer has spoken, or has failed and said why."""
        return self.objective is not None or bool(self.error)

    @functools.cached_property
    def line(self) -> str:
        """The row as a line of CSV, kept: the whole table is written whenever a row is added."""
        return _line([_format(value) for value in _cells(self)])


#: No number of the table is larger unless the file is damaged; sums and ratios then stay finite.
LARGEST = 1e15
COLUMNS = tuple(field.name for field in dataclasses.fields(Row))
_cells = operator.attrgetter(*COLUMNS)
_TYPES = {field.name: str(field.type).removesuffix(" | None") for field in dataclasses.fields(Row)}
_REQUIRED = ("instance", "split", "regime", "method", "settings", "status")


class Results:
    """A results folder. Several processes may add rows to it at the same time."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.path = self.folder / "results.csv"
        self.rows: dict[Key, Row] = {}
        self._seen: tuple[int, int] | None = None  # the file that `rows` came from or went to
        self.reload()

    def reload(self) -> None:
        """Read the table as it is on disk now; InputError if a row is wrong."""
        seen = self._file()
        if seen != self._seen or seen is None:
            self.rows = {row.key: row for row in read_rows(self.path)} if seen else {}
            self._seen = seen

    def add(self, rows: Iterable[Row]) -> None:
        """Save rows at once, replacing those with the same key; other writers' rows are kept."""
        with self._locked():
            self.reload()
            self.rows = self.rows | {row.key: row for row in rows}
            write_atomically(self.path, format_rows(self.rows.values()))
            self._seen = self._file()

    def has(self, key: Key, fingerprint: str) -> bool:
        """Whether a row is finished: same fingerprint, schedule on disk, scored."""
        row = self.rows.get(key)
        return self.solved(key, fingerprint) and row is not None and row.scored

    def solved(self, key: Key, fingerprint: str) -> bool:
        """Whether a schedule for this row is on disk, scored or not."""
        row = self.rows.get(key)
        return row is not None and row.fingerprint == fingerprint and self.schedule_path(key).is_file()

    def schedule_path(self, key: Key) -> Path:
        """Where the schedule of a row is kept."""
        return self.folder / "schedules" / key.method / key.settings / key.regime / f"{key.instance}.csv.gz"

    def schedule(self, key: Key, case: Case, instance: Instance) -> Schedule:
        """Read the schedule of a row; InputError if it is missing or wrong."""
        return Schedule.read(self.schedule_path(key), case, instance.horizon_s)

    def frame(self) -> pd.DataFrame:
        """The table, one row each, typed columns; empty cells are missing values."""
        frame = pd.DataFrame(map(_cells, self.rows.values()), columns=list(COLUMNS))
        for name, kind in _TYPES.items():
            if kind == "float":
                frame[name] = frame[name].astype("float64")
        return frame

    def _file(self) -> tuple[int, int] | None:
        """What changes whenever the file is replaced, which is how every writer changes it."""
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.folder / ".lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield  # closing the file releases the lock


def format_rows(rows: Iterable[Row]) -> str:
    """Rows as CSV text; floats keep every digit, missing values are empty."""
    return _line(COLUMNS) + "".join(row.line for row in rows)


def _line(cells: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def read_rows(path: Path) -> list[Row]:
    """Read a results table.

    Raises:
        InputError: a column is missing or unknown, or a value is wrong; names line and column.
    """
    return [
        Row(**{name: _parse(cell, name, path, number) for name, cell in cells.items()})
        for number, cells in read_table(path, COLUMNS)
    ]


def read_table(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and cells by column of a CSV file that has exactly these columns.

    Raises:
        InputError: a column is missing or unknown, or a line has too many or too few values.
    """
    try:
        table = list(csv.reader(io.StringIO(read_text(path), newline="")))
    except csv.Error as error:
        raise InputError(path, "", f"is not a CSV file ({error})") from None
    header = table[0] if table else []
    if missing := [name for name in columns if header.count(name) != 1]:
        raise InputError(path, missing[0], "column required once")
    if unknown := [name for name in header if name not in columns]:
        raise InputError(path, unknown[0][:40], "unknown column")
    for number, cells in enumerate(table[1:], start=2):
        if len(cells) != len(header):
            raise InputError(path, f"line {number}", f"{len(cells)} values for {len(header)} columns")
        yield number, dict(zip(header, cells, strict=True))


def _format(value: Any) -> str:
    if value is None:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def _parse(cell: str, name: str, path: Path, line: int) -> Any:
    kind = _TYPES[name]
    try:
        if kind == "str":
            if not cell and name in _REQUIRED:
                raise ValueError
            if name == "status":
                return str(Status(cell))
            if name in ("instance", "regime", "method", "settings") and (
                "/" in cell or "\\" in cell or cell.startswith(".")
            ):
                raise ValueError
            return cell
        if not cell:
            return 1 if name == "workers" else None
        if kind == "bool":
            return {"True": True, "False": False}[cell]
        value = int(cell) if kind == "int" else float(cell)
        if not abs(value) <= LARGEST:
            raise ValueError
        return value
    except (ValueError, KeyError):
        raise InputError(path, f"line {line}, {name}", f"{cell[:30]!r} is not a valid value") from None
