"""How long a method takes from measurement to plan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.timing import WARM_UP, TimingRow, read_timing


def timed_latency(case: Case, regime: str, method: str, settings: str, folders: Sequence[Path]) -> float:
    """Median build and solve time in the `timing.csv` of the first folder that timed the method, s.

    Raises:
        InputError: none of the folders has such times (names the command that makes them).
    """
    for folder in folders:
        rows = read_timing(ResultsFolder(folder).timing)
        times = [_seconds(row) for row in rows if _is_meant(row, case.id, (regime, method, settings))]
        if times:
            return float(np.median(times))
    wanted = f"{method} {settings} {regime}"
    problem = "is not timed; run `ded-bench bench`, or give --latency in seconds"
    raise InputError("--latency timing", wanted, problem)


def _is_meant(row: TimingRow, case: str, name: tuple[str, str, str]) -> bool:
    timed = row.case == case and (row.regime, row.method, row.settings) == name
    return timed and row.round != WARM_UP and not row.error


def _seconds(row: TimingRow) -> float:
    return (row.build_s or 0.0) + (row.solve_s or 0.0)
