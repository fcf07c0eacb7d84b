"""The table of times: one row per call of a method, and medians per method, settings, model and regime."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.files.table import Table, cell
from ded_bench.results.legacy import upgraded

#: Round of a process's very first call, on the warm-up instance; it enters no median.
WARM_UP = 0
PARTS = ("build_s", "setup_s", "solve_s")


@dataclass(frozen=True)
class TimingRow:
    """One call of one method, wall-clock seconds.

    `settings` are those that matter outside the closed loop. `call_s` is the whole call as its process saw
    it, `load_average` the machine's over the last minute, when the call ended: at most about 1 if bench was
    alone. `peak_memory_mib` is the most that its process had held by the end of the call, all that it imports
    included.
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
    load_average: float | None = cell(default=None, lowest=0)
    peak_memory_mib: float | None = cell(default=None, lowest=0)
    error: str = ""
    model: str = ""
    policy: str = ""
    case: str = ""
    problems_version: str = ""
    version: str = ""
    commit: str = ""
    method_version: int = 0
    solver_version: str = ""
    host: str = ""
    date: str = ""

    @property
    def job(self) -> tuple[str, str, str, str]:
        """Regime, method, settings and the surrogate's name: what is timed."""
        return self.regime, self.method, self.settings, model_name(self.model)

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes a row unique within its run."""
        return self.round, *self.job, self.instance

    @property
    def counts(self) -> bool:
        """Whether it enters medians: a call that succeeded, and no process's first."""
        return self.round != WARM_UP and not self.error


TIMING: Table[TimingRow] = Table(TimingRow, since="method_version", upgrade=upgraded)


def model_name(model: str) -> str:
    """The surrogate's name in `name@fingerprint`; empty for none."""
    return model.partition("@")[0]


def read_timing(path: Path) -> list[TimingRow]:
    """Read a timing table; no rows if there is no such file.

    Raises:
        InputError: a column is missing, or a value is wrong; names line and column.
    """
    return TIMING.read(path) if path.exists() else []


def timing_summary(rows: Sequence[TimingRow]) -> pd.DataFrame:
    """Median and quartiles per case and job over instances and rounds, s; `model` is the surrogate's name.

    The first call of each process does not count; calls that failed count in `failures` and enter no
    median. `load_average` is the median of the calls', `peak_memory_mib` the largest.
    """
    parts: dict[tuple[str, ...], list[TimingRow]] = {}
    for row in rows:
        parts.setdefault((row.case, *row.job), []).append(row)
    frame = pd.DataFrame([_summary(calls) for calls in parts.values()], columns=list(SUMMARY_COLUMNS))
    return frame.astype(dict.fromkeys(_NUMBERS, "float64"))


_TIMES = tuple(f"{name}{end}" for name in reversed(PARTS) for end in ("", "_q1", "_q3"))
_MORE = ("load_average", "peak_memory_mib")
_NUMBERS = (*_TIMES, *_MORE)
_SAID = ("run", "case", "problems_version", "version", "commit", "solver_version", "host", "date", "policy")
SUMMARY_COLUMNS = (
    *("regime", "method", "settings", "model", "instances", "repeats", "failures"),
    *(*_NUMBERS, "error", *_SAID),
)


def _summary(calls: Sequence[TimingRow]) -> dict[str, Any]:
    last = calls[-1]
    warm = [row for row in calls if row.round != WARM_UP]
    good = [row for row in warm if row.counts]
    facts: dict[str, Any] = dict(zip(SUMMARY_COLUMNS, last.job, strict=False))
    facts |= {
        "instances": len({row.instance for row in warm}),
        "repeats": max((row.round for row in warm), default=0),
        "failures": len(warm) - len(good),
        "load_average": np.median(_values(warm, "load_average") or [math.nan]),
        "peak_memory_mib": max(_values(warm, "peak_memory_mib"), default=None),
        "error": "" if good else next((row.error for row in warm if row.error), ""),
    }
    for name in PARTS:
        times = np.quantile(_values(good, name) or [math.nan], (0.5, 0.25, 0.75))
        facts |= dict(zip((name, f"{name}_q1", f"{name}_q3"), times.tolist(), strict=True))
    return facts | {name: getattr(last, name) for name in _SAID}


def _values(rows: Sequence[TimingRow], name: str) -> list[float]:
    return [value for row in rows if (value := getattr(row, name)) is not None]
