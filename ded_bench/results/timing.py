"""The table of times: one row per call of a method, and medians per method and regime."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.summary import quartiles
from ded_bench.files.table import Table, cell

#: Round of a process's very first call, on the warm-up instance; it enters no median.
WARM_UP = 0
PARTS = ("build_s", "setup_s", "solve_s")


@dataclass(frozen=True)
class TimingRow:
    """One call of one method, wall-clock seconds.

    `call_s` is the whole call as its process saw it, `load_average` the machine's over the last minute,
    when the call ended: at most about 1 if bench was alone. `schedule_difference_pu` is max |ΔP| between
    this call's schedule and the one that the results folder keeps, `peak_memory_mib` the most that its
    process had held by the end of the call, all that it imports included.
    """

    run: str
    round: int
    regime: str
    method: str
    settings: str
    instance: str
    status: str
    build_s: float | None = cell(default=None, lowest=0)
    setup_s: float | None = cell(default=None, lowest=0)
    solve_s: float | None = cell(default=None, lowest=0)
    call_s: float | None = cell(default=None, lowest=0)
    schedule_difference_pu: float | None = cell(default=None, lowest=0)
    load_average: float | None = cell(default=None, lowest=0)
    peak_memory_mib: float | None = cell(default=None, lowest=0)
    error: str = ""
    model: str = ""
    policy: str = ""
    code: str = ""
    case: str = ""
    problems_version: str = ""
    version: str = ""
    solver_version: str = ""
    host: str = ""
    date: str = ""

    @property
    def key(self) -> tuple[int, str, str, str, str]:
        """What makes a row unique within its run."""
        return self.round, self.regime, self.method, self.settings, self.instance


TIMING: Table[TimingRow] = Table(TimingRow)


def read_timing(path: Path) -> list[TimingRow]:
    """Read a timing table; no rows if there is no such file.

    Raises:
        InputError: a column is missing, or a value is wrong; names line and column.
    """
    return TIMING.read(path) if path.exists() else []


def timing_summary(rows: Sequence[TimingRow]) -> pd.DataFrame:
    """Median and quartiles per (case, regime, method, settings) over instances and rounds, s.

    The first call of each process enters as `first_…` alone; calls that failed count in `failures` and
    enter no median. `load_average` is the median of the calls', `schedule_difference_pu` and
    `peak_memory_mib` are the largest.
    """
    parts: dict[tuple[str, ...], list[TimingRow]] = {}
    for row in rows:
        parts.setdefault((row.case, row.regime, row.method, row.settings), []).append(row)
    found = [_summary(calls) for calls in parts.values()]
    frame = pd.DataFrame(found, columns=list(SUMMARY_COLUMNS))
    numbers = [
        name for name in SUMMARY_COLUMNS if name.endswith(("_s", "_q1", "_q3", "_pu", "_average", "_mib"))
    ]
    return frame.astype(dict.fromkeys(numbers, "float64"))


_NAMES = ("case", "problems_version", "version", "solver_version", "host", "date", "model", "policy", "code")
SUMMARY_COLUMNS = (
    *("regime", "method", "settings", "instances", "repeats", "failures"),
    *(f"{name}{end}" for name in reversed(PARTS) for end in ("", "_q1", "_q3")),
    *(f"first_{name}" for name in PARTS),
    *("load_average", "schedule_difference_pu", "peak_memory_mib", "error", "run", *_NAMES),
)


def _summary(calls: Sequence[TimingRow]) -> dict[str, Any]:
    first = next((row for row in calls if row.round == WARM_UP), None)
    warm = [row for row in calls if row.round != WARM_UP]
    good = [row for row in warm if not row.error]
    last = calls[-1]
    errors = [row.error for row in warm if row.error]
    facts: dict[str, Any] = {
        "regime": last.regime,
        "method": last.method,
        "settings": last.settings,
        "instances": len({row.instance for row in warm}),
        "repeats": max((row.round for row in warm), default=0),
        "failures": len(errors),
        "load_average": float(np.median(_values(warm, "load_average") or [np.nan])),
        "schedule_difference_pu": max(_values(warm, "schedule_difference_pu"), default=None),
        "peak_memory_mib": max(_values(warm, "peak_memory_mib"), default=None),
        "error": "" if good or not errors else errors[0],
        "run": last.run,
    }
    facts |= {f"first_{name}": getattr(first, name, None) for name in PARTS}
    for name in PARTS:
        facts |= quartiles(name, np.array(_values(good, name), dtype=float))
    return facts | {name: getattr(last, name) for name in _NAMES}


def _values(rows: Sequence[TimingRow], name: str) -> list[float]:
    return [value for row in rows if (value := getattr(row, name)) is not None]
