"""Schedule: generator power over time, piecewise linear; CSV on disk."""

from __future__ import annotations

import csv
import gzip
import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.problem.case import Array, Case

#: How far a schedule's last time may lie from the horizon, s.
HORIZON_TOLERANCE = 1e-9
MAX_BYTES = 200 * 2**20


@dataclass(frozen=True, eq=False)
class Schedule:
    """Generator powers `p`, shape (n, n_gen) in pu, at strictly increasing times `t`, shape (n,) in s.

    Between its rows a schedule is linear. Methods and scorer evaluate it at the grid points t_k and
    take it linear between neighbouring t_k.
    """

    t: Array
    p: Array

    def at(self, times: Array) -> Array:
        """Powers at `times`, shape (n_times, n_gen), pu, by linear interpolation."""
        return np.stack([np.interp(times, self.t, column) for column in self.p.T], axis=1)

    def write(self, path: Path, generators: tuple[str, ...]) -> None:
        """Write as CSV, compressed if the name ends in `.gz`; 15 significant digits."""
        text = io.StringIO()
        header = ",".join(["t", *(f"P_{g}" for g in generators)])
        np.savetxt(
            text, np.column_stack([self.t, self.p]), fmt="%.15g", delimiter=",", header=header, comments=""
        )
        data = text.getvalue().encode()
        write_atomically(path, gzip.compress(data, 3, mtime=0) if path.suffix == ".gz" else data)

    @staticmethod
    def read(path: str | Path, case: Case, horizon_s: float) -> Schedule:
        """Read a schedule for `case` that spans 0 to `horizon_s`.

        Raises:
            InputError: the file cannot be read, a column is missing or unknown, a value is not a
                finite number, times do not increase strictly from 0 to the horizon.
        """
        header, rows = _read_table(path)
        wanted = ["t", *(f"P_{g}" for g in case.generators)]
        expected = f"expected {','.join(wanted)}, found {repr(','.join(header)[:100])[1:-1] or 'nothing'}"
        for name in wanted:
            if header.count(name) != 1:
                what = "column is there twice" if name in header else "required column is missing"
                raise InputError(path, name, f"{what} ({expected})")
        if unknown := [name for name in header if name not in wanted]:
            raise InputError(path, repr(unknown[0][:40])[1:-1], f"unknown column ({expected})")
        values = _numbers(rows, header, path)[:, [header.index(name) for name in wanted]]
        schedule = Schedule(t=values[:, 0].copy(), p=values[:, 1:].copy())
        schedule.check(horizon_s, path)
        return schedule

    def check(self, horizon_s: float, source: str | Path = "schedule") -> None:
        """Raise InputError unless times increase strictly from 0 to the horizon and all is finite."""
        if len(self.t) < 2:
            raise InputError(source, "t", "at least two rows are needed")
        if not (np.isfinite(self.t).all() and np.isfinite(self.p).all()):
            raise InputError(source, "P", "values must be finite numbers")
        if not (np.diff(self.t) > 0).all():
            row = int(np.argmax(np.diff(self.t) <= 0))
            raise InputError(
                source, "t", f"must increase strictly, but {self.t[row + 1]} follows {self.t[row]}"
            )
        if abs(self.t[0]) > HORIZON_TOLERANCE:
            raise InputError(source, "t", f"must start at 0, not {self.t[0]}")
        if abs(self.t[-1] - horizon_s) > HORIZON_TOLERANCE:
            raise InputError(source, "t", f"must end at the horizon {horizon_s}, not {self.t[-1]}")


def _read_table(path: str | Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Column names, and the other rows that are not blank, each with its line number."""
    try:
        with open(path, "rb") as raw:
            stream = gzip.GzipFile(fileobj=raw) if str(path).endswith(".gz") else raw
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise InputError(path, "", "is too large for a schedule")
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        rows = [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise InputError(path, "", f"cannot be read ({error.strerror or error})") from None
    except (UnicodeDecodeError, csv.Error, EOFError, ValueError, zlib.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", "is not a CSV text file") from None
    if not rows:
        raise InputError(path, "t", "is empty")
    return [name.strip() for name in rows[0][1]], rows[1:]


def _numbers(rows: list[tuple[int, list[str]]], header: list[str], path: str | Path) -> Array:
    """The numbers of a table, shape (n_rows, n_columns); InputError names the first cell that is none."""
    shape = len(rows), len(header)
    try:
        values = np.array([row for _, row in rows], dtype=float).reshape(shape)
    except ValueError:  # some cell is no number, or some row too short or too long
        values = np.full(shape, np.nan)
    if not np.isfinite(values).all() or any("_" in cell for _, row in rows for cell in row):
        for number, row in rows:
            if len(row) != len(header):
                raise InputError(path, f"line {number}", f"{len(row)} values for {len(header)} columns")
            for column, cell in zip(header, row, strict=True):
                _check_number(cell, path, f"line {number}, {column}")
    return values


def _check_number(cell: str, path: str | Path, field: str) -> None:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or "_" in cell:
        raise InputError(path, field, f"{cell[:20]!r} is not a finite number")
