"""Schedule: generator power over time, piecewise linear, CSV on disk; Trajectory: what it leads to."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_text, write_atomically
from ded_bench.files.table import records
from ded_bench.problem.case import Array, Case

if TYPE_CHECKING:
    import pandas as pd

#: How far a schedule's last time may lie from the horizon, s.
HORIZON_TOLERANCE = 1e-9
MAX_BYTES = 200 * 2**20
#: Ten rows for each step of a minute: more would cost memory, and no simulation sees them.
MAX_ROWS = 100_000


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
        from ded_bench.problem.compiled import interpolated  # and with it Numba

        return interpolated(self.t, np.ascontiguousarray(self.p), times)

    def write(self, path: str | Path, generators: tuple[str, ...]) -> None:
        """Write as CSV, compressed if the name ends in `.gz`; 15 significant digits."""
        text = io.StringIO()
        header, table = ",".join(["t", *(f"P_{g}" for g in generators)]), np.column_stack([self.t, self.p])
        np.savetxt(text, table, fmt="%.15g", delimiter=",", header=header, comments="")
        write_atomically(Path(path), text.getvalue())

    @staticmethod
    def read(path: str | Path, case: Case, horizon_s: float) -> Schedule:
        """Read a schedule for `case` that spans 0 to `horizon_s`.

        Raises:
            InputError: the file cannot be read, a column is missing or unknown, a value is not a
                finite number, times do not increase strictly from 0 to the horizon.
        """
        text = read_text(path, MAX_BYTES)
        if text.count("\n") > MAX_ROWS:
            raise InputError(path, "", f"has more than {MAX_ROWS} rows")
        rows = [(line, cells) for line, cells in records(text, path) if cells]
        if not rows:
            raise InputError(path, "t", "is empty")
        header, wanted = [name.strip() for name in rows[0][1]], columns_of(case)
        expected = f"expected {','.join(wanted)}, found {repr(','.join(header)[:100])[1:-1] or 'nothing'}"
        for name in wanted:
            if header.count(name) != 1:
                what = "column is there twice" if name in header else "required column is missing"
                raise InputError(path, name, f"{what} ({expected})")
        if unknown := [name for name in header if name not in wanted]:
            raise InputError(path, repr(unknown[0][:40])[1:-1], f"unknown column ({expected})")
        values = _numbers(rows[1:], header, path)[:, [header.index(name) for name in wanted]]
        schedule = Schedule(t=values[:, 0].copy(), p=values[:, 1:].copy())
        schedule.check(horizon_s, path)
        return schedule

    def check(self, horizon_s: float, source: str | Path = "schedule") -> None:
        """Raise InputError unless times increase strictly from 0 to the horizon and all is finite."""
        if len(self.t) < 2:
            raise InputError(source, "t", "at least two rows are needed")
        if not (np.isfinite(self.t).all() and np.isfinite(self.p).all()):
            raise InputError(source, "P", "values must be finite numbers")
        if (back := np.flatnonzero(np.diff(self.t) <= 0)).size:
            before, after = self.t[back[0] : back[0] + 2]
            raise InputError(source, "t", f"must increase strictly, but {after} follows {before}")
        if abs(self.t[0]) > HORIZON_TOLERANCE:
            raise InputError(source, "t", f"must start at 0, not {self.t[0]}")
        if abs(self.t[-1] - horizon_s) > HORIZON_TOLERANCE:
            raise InputError(source, "t", f"must end at the horizon {horizon_s}, not {self.t[-1]}")


def columns_of(case: Case) -> list[str]:
    """The columns of a schedule's file: time in s, then each generator's power in pu."""
    return ["t", *(f"P_{generator}" for generator in case.generators)]


def as_schedule(given: Schedule | pd.DataFrame, case: Case) -> Schedule:
    """A schedule whose times and powers are arrays of floats.

    Args:
        given: a schedule, its `t` and `p` arrays or nested lists; or a data frame with the columns of a
            schedule's file, `t` (s) and `P_<bus>` (pu), and perhaps others, such as that of a trajectory.

    Raises:
        InputError: it is something else, a column is missing, or shapes or values are wrong.
    """
    if isinstance(given, Schedule):
        t, p = given.t, given.p
    elif hasattr(given, "columns"):
        names = columns_of(case)
        found = [str(name) for name in given.columns]
        for name in names:
            if found.count(name) != 1:
                raise InputError("schedule", name, f"one such column is needed (found: {', '.join(found)})")
        t, p = given[names[0]].to_numpy(), given[names[1:]].to_numpy()
    else:
        problem = f"is a {type(given).__name__}; give a Schedule, or a data frame with columns t, P_<bus>"
        raise InputError("schedule", "", problem)
    try:
        if np.iscomplexobj(t) or np.iscomplexobj(p):  # NumPy would only warn
            raise TypeError("some are complex")
        times, powers = np.asarray(t, dtype=np.float64), np.asarray(p, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("schedule", "t, P", f"must be real numbers, a row for each time ({error})") from None
    if times.ndim != 1 or powers.shape != (len(times), len(case.generators)):
        wanted = f"({len(times)}, {len(case.generators)}): a row per time, a column per generator"
        raise InputError("schedule", "P", f"has the shape {powers.shape}, but needs {wanted}")
    return Schedule(times, powers)


def _numbers(rows: list[tuple[int, list[str]]], header: list[str], path: str | Path) -> Array:
    """The numbers of a table, shape (n_rows, n_columns); InputError names the first cell that is none."""
    values = np.full((len(rows), len(header)), np.nan)
    for i, (line, cells) in enumerate(rows):
        if len(cells) != len(header):
            raise InputError(path, f"line {line}", f"{len(cells)} values for {len(header)} columns")
        for j, cell in enumerate(cells):
            with contextlib.suppress(ValueError):
                values[i, j] = float(cell)
            if not math.isfinite(values[i, j]) or "_" in cell:
                raise InputError(path, f"line {line}, {header[j]}", f"{cell[:20]!r} is not a finite number")
    return values


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What one instance does under one schedule, at the grid points t_k."""

    t: Array  # (n,), s
    omega: Array  # (n, n_gen), rad/s, deviation from nominal
    p_set: Array  # (n, n_gen), pu: set-points
    p_gen: Array  # (n, n_gen), pu: delivered
    p_load: Array  # (n, n_load), pu
    p_slack: Array  # (n,), pu
    case: Case
    states: Any = None  # of the plant that made it, for its own use
    columns: Mapping[str, Array] = field(default_factory=dict)  # the plant's own by name, (n,), pu or rad

    def cost(self, cost_gen: Array, cost_slack: float) -> float:
        """Cost Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all grid points (paper), of c_i (n_gen,)."""
        return float((self.p_gen @ cost_gen + cost_slack * np.abs(self.p_slack)).sum())

    def to_frame(self) -> pd.DataFrame:
        """One row per grid point, columns named by bus in the case's order.

        `t` (s); `P_<bus>` of the generators, delivered, then of the slack, if there is one (pu);
        `L_<bus>` of the loads (injections, pu); `omega_<bus>` of the generators (rad/s, deviation from
        nominal); then the plant's own, such as `theta_<bus>` (rad, relative to the slack).
        """
        import pandas as pd  # here only: the scorer does without it

        case = self.case
        columns = {"t": self.t}
        columns |= {f"P_{bus}": values for bus, values in zip(case.generators, self.p_gen.T, strict=True)}
        columns |= {} if case.slack is None else {f"P_{case.slack}": self.p_slack}
        columns |= {f"L_{bus}": values for bus, values in zip(case.loads, self.p_load.T, strict=True)}
        columns |= {f"omega_{bus}": values for bus, values in zip(case.generators, self.omega.T, strict=True)}
        return pd.DataFrame(columns | dict(self.columns))
