"""The paper's Tables V and VI, with the paper's numbers beside ours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ded_bench.evaluate.summary import GROUP, HEAD, REFERENCE, groups, table, title
from ded_bench.problem.case import Case


class PaperRow(NamedTuple):
    """One method of the paper's Tables V and VI; None where the paper says NA."""

    increase_percent: float | None
    solve_s: float
    freq_violation_hz: float
    ramp_violation: float


#: Fingerprint of the paper's grid, limits and sampling ranges: its numbers are about no other case.
PAPER_CASE = "a0fa08e05e5d"
#: The numbers of the paper's Tables V (Average Solution Time and Change in Objective) and VI (Average
#: maximum constraint violation over Test Problems), by (regime, method).
PAPER: dict[tuple[str, str], PaperRow] = {
    ("NO", "DED"): PaperRow(None, 32.34, 0.0, 1.84e-9),
    ("NO", "DED-KO"): PaperRow(0.094, 17.34, 0.0, 2.0e-9),
    ("NO", "DED-DPC"): PaperRow(1.05, 6.8e-4, 0.0, 1.11e-4),
    ("TO", "DED"): PaperRow(None, 32.38, 7.5e-5, 1.9e-9),
    ("TO", "DED-KO"): PaperRow(0.3, 18.8, 0.0013, 1.9e-9),
    ("TO", "DED-DPC"): PaperRow(5.2, 6.8e-4, 0.0011, 4.2e-5),
}
#: Which of our methods answers to which row of the paper, first one present.
COUNTERPARTS = {"DED": ("ded",), "DED-KO": ("ded-ko",), "DED-DPC": ("ded-dpc", "ded-dpc-paper")}
#: Rows that Tables V and VI show even before anything was run.
EXPECTED = ("ded", "ded-ko", "ded-dpc-paper")

TABLE_V_COLUMNS = [
    *HEAD,
    *("increase_percent", "paper_increase_percent", "solve_s", "paper_solve_s"),
    *("n", "failures", "ahead_increase", "ahead_time"),
]
TABLE_VI_COLUMNS = [
    *HEAD,
    *("freq_violation_hz", "paper_freq_violation_hz", "ramp_violation", "paper_ramp_violation"),
    *("n", "failures", "ahead_frequency", "ahead_ramp"),
]


def paper_numbers(case: Case) -> Mapping[tuple[str, str], PaperRow]:
    """The paper's numbers if they are about this case, else none."""
    return PAPER if case.fingerprint == PAPER_CASE else {}


def table_v(
    overview: pd.DataFrame, timing: pd.DataFrame, paper: Mapping[tuple[str, str], PaperRow]
) -> pd.DataFrame:
    """The paper's Table V with the paper's numbers beside ours, from a summary of the rows.

    The increase is the mean signed gap over `n` instances; it is not available for DED itself. The
    time is the median of `solve_s` in the timing table (see `timing.latest_host`), empty without one.
    """
    rows = []
    for row, theirs in _paper_rows(overview, paper):
        increase = row.get("gap_percent_mean", np.nan)
        if (row["method"], row["settings"]) == REFERENCE:
            increase = np.nan
        timed = timing[(timing[GROUP] == [row[name] for name in GROUP]).all(axis=1)]
        seconds = float(timed["solve_s"].iloc[-1]) if len(timed) else np.nan
        failures = row["failures"]
        rows.append(
            {name: row[name] for name in (*GROUP, "title")}
            | {
                "increase_percent": increase,
                "paper_increase_percent": theirs.increase_percent if theirs else None,
                "solve_s": seconds,
                "paper_solve_s": theirs.solve_s if theirs else None,
                "n": row["n"],
                "failures": failures,
                "ahead_increase": _ahead(increase, theirs and theirs.increase_percent, failures),
                "ahead_time": _ahead(seconds, theirs and theirs.solve_s, int(timed["failures"].sum())),
            }
        )
    return table(rows, TABLE_V_COLUMNS)


def table_vi(overview: pd.DataFrame, paper: Mapping[tuple[str, str], PaperRow]) -> pd.DataFrame:
    """The paper's Table VI from a summary: mean of each instance's largest violation."""
    rows = []
    for row, theirs in _paper_rows(overview, paper):
        freq = row.get("freq_violation_hz_mean", np.nan)
        ramp = row.get("ramp_violation_mean", np.nan)
        failures = row["failures"]
        rows.append(
            {name: row[name] for name in (*GROUP, "title")}
            | {
                "freq_violation_hz": freq,
                "paper_freq_violation_hz": theirs.freq_violation_hz if theirs else None,
                "ramp_violation": ramp,
                "paper_ramp_violation": theirs.ramp_violation if theirs else None,
                "n": row["rows"] - failures,
                "failures": failures,
                "ahead_frequency": _ahead(freq, theirs and theirs.freq_violation_hz, failures),
                "ahead_ramp": _ahead(ramp, theirs and theirs.ramp_violation, failures),
            }
        )
    return table(rows, TABLE_VI_COLUMNS)


def _paper_rows(
    overview: pd.DataFrame, paper: Mapping[tuple[str, str], PaperRow]
) -> Iterator[tuple[dict[str, Any], PaperRow | None]]:
    """Rows of the summary and of the paper side by side; rows that nobody ran yet have n = 0."""
    rows = {tuple(str(row[name]) for name in GROUP): row for row in overview.to_dict("records")}
    order = [(regime, method, settings) for regime, method, settings, _ in groups(overview)]
    missing = [
        (regime, method, "default")
        for regime in dict.fromkeys(regime for regime, _ in paper)
        for method in EXPECTED
        if (regime, method, "default") not in rows
    ]
    everything = pd.DataFrame([*order, *missing], columns=GROUP)
    for regime, method, settings, _ in groups(everything):
        row: dict[str, Any] = dict(zip(GROUP, (regime, method, settings), strict=True))
        row |= {"title": title(method, settings), "rows": 0, "n": 0, "failures": 0}
        row |= {str(name): value for name, value in rows.get((regime, method, settings), {}).items()}
        yield row, _theirs(regime, method, settings, rows, paper)


def _theirs(
    regime: str,
    method: str,
    settings: str,
    rows: Mapping[tuple[str, ...], object],
    paper: Mapping[tuple[str, str], PaperRow],
) -> PaperRow | None:
    for name, ours in COUNTERPARTS.items():
        present = [m for m in ours if (regime, m, "default") in rows] or list(ours[-1:])
        if settings == "default" and method == present[0]:
            return paper.get((regime, name))
    return None


def _ahead(ours: object, theirs: float | None, failures: object) -> str:
    """Whether a number is below the paper's; a mean over survivors never is."""
    if theirs is None or not isinstance(ours, float) or np.isnan(ours):
        return ""
    if failures:
        return "no"
    return "yes" if ours < theirs else "equal" if ours == theirs else "no"
