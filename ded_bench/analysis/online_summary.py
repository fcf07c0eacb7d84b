"""What online.csv says of every method at its own latency."""

from __future__ import annotations

from typing import Any

import pandas as pd

from ded_bench.analysis.lines import GROUP, line_table, named
from ded_bench.problem.forecast import QUALITIES
from ded_bench.results.online_results import ONLINE, OnlineResults

#: What rows of one line of a table share, besides the scenario.
LOOP = [*GROUP, "period_s", "latency_s", "warm"]
#: The operator's practice that others are set beside: method and settings.
STATIC = ("ed", "every=1")
#: Own latencies that differ by so small a part share a line.
SAME = 0.01


def online_rows(results: OnlineResults, case: str) -> pd.DataFrame:
    """Rows of a case at methods' own latencies, forecasts as announced, in the order of the table.

    `static_objective` and `static_excess_hz` are those of static dispatch of every second.
    """
    rows = list(results.table.rows.values())
    frame = named(ONLINE.frame(rows).assign(key=pd.Series([row.key for row in rows], dtype=object)))
    own = (frame["latency_source"] == "timing") & (frame["forecast"] == QUALITIES[0])
    frame = frame[own & frame["predicted"].astype(bool) & (frame["case"] == case)].reset_index(drop=True)
    typical = frame.groupby([*GROUP, "period_s", "warm"])["latency_s"].transform("median")
    close = (frame["latency_s"] - typical).abs() <= SAME * typical
    frame["latency_s"] = frame["latency_s"].mask(close, typical)
    static = frame[
        (frame["method"] == STATIC[0]) & (frame["settings"] == STATIC[1]) & (frame["period_s"] == 1)
    ]
    found = static.drop_duplicates(["regime", "scenario"], keep="last").set_index(["regime", "scenario"])
    names = {"objective": "static_objective", "max_excess_hz": "static_excess_hz"}
    return frame.join(found[list(names)].rename(columns=names), on=["regime", "scenario"])


def own_latency(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method, period and latency."""
    made = [dict(zip(LOOP, key, strict=True)) | _line(rows) for key, rows in frame.groupby(LOOP, sort=False)]
    return line_table(made, [*LOOP, *_line(frame)])


def _line(rows: pd.DataFrame) -> dict[str, Any]:
    """Means and maxima over the scenarios that were operated to their end; plans are counted over all."""
    done = rows.dropna(subset=["objective"])
    plans = max(int(rows["plans"].sum()), 1)
    return {
        "n": len(done),
        "failures": len(rows) - len(done),
        "increase_percent_mean": done["increase_percent"].mean(),
        "increase_percent_max": done["increase_percent"].max(),
        "over_static_percent_mean": 100 * (done["objective"] / done["static_objective"] - 1).mean(),
        "static_excess_mhz_mean": 1e3 * done["static_excess_hz"].mean(),
        "max_excess_mhz_mean": 1e3 * done["max_excess_hz"].mean(),
        "max_excess_mhz_max": 1e3 * done["max_excess_hz"].max(),
        "unforeseen_mhz_mean": 1e3 * done["unforeseen_hz"].mean(),
        "share_outside": done["share_outside"].mean(),
        "slack_travel_pu": done["slack_travel_pu"].mean(),
        **{name: float(rows[name].sum()) / plans for name in ("late", "failed", "infeasible")},
    }
