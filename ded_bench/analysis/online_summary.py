"""What online.csv says: every method at its own latency, and sweeps over latency, forecast and state."""

from __future__ import annotations

from typing import Any

import pandas as pd

from ded_bench.analysis.lines import GROUP, line_table, named
from ded_bench.problem.forecast import QUALITIES
from ded_bench.results.online_results import ONLINE, OnlineResults

#: What rows of one line of a table share, besides the scenario.
LOOP = [*GROUP, "period_s", "latency_s", "forecast", "predicted", "warm"]
#: The operator's practice that others are set beside: method and settings.
STATIC = ("ed", "every=1")
#: A method with so many latencies at one forecast was swept.
SWEPT = 3
#: Own latencies that differ by so small a part share a line.
SAME = 0.01
#: Forecasts of a sweep, and plans from the present state under announcements.
KINDS = (*QUALITIES, "present")


def online_rows(results: OnlineResults, case: str) -> pd.DataFrame:
    """Rows of a case in the order of the table; `kind` is the forecast, or `present`.

    `over_known_percent` is the cost over the same method's on the scenario with a perfect forecast and no
    latency, %; `static_objective` and `static_excess_hz` are those of static dispatch of every second.
    """
    rows = list(results.table.rows.values())
    frame = named(ONLINE.frame(rows).assign(key=pd.Series([row.key for row in rows], dtype=object)))
    frame = frame[frame["case"] == case]
    predicted, announced = frame["predicted"].astype(bool), frame["forecast"] == QUALITIES[0]
    frame = frame.assign(kind=frame["forecast"].where(predicted, "present"))
    frame = frame[predicted | announced].reset_index(drop=True)
    frame["latency_s"] = _shared_latency(frame)
    known = frame[(frame["kind"] == "perfect") & (frame["latency_s"] == 0) & frame["warm"].astype(bool)]
    best = known.drop_duplicates([*GROUP, "scenario"]).set_index([*GROUP, "scenario"])["objective"]
    same = best.reindex(pd.MultiIndex.from_frame(frame[[*GROUP, "scenario"]])).to_numpy()
    frame["over_known_percent"] = 100 * (frame["objective"].to_numpy() / same - 1)
    return frame.join(_static(frame), on=["regime", "scenario"])


def _shared_latency(frame: pd.DataFrame) -> pd.Series[float]:
    """Latencies, s; a method's own ones that a new table of times moved by next to nothing are one."""
    alike = ["latency_source", *(name for name in LOOP if name != "latency_s")]
    typical = frame.groupby(alike)["latency_s"].transform("median")
    close = (frame["latency_s"] - typical).abs() <= SAME * typical
    return frame["latency_s"].mask((frame["latency_source"] == "timing") & close, typical)


def _static(frame: pd.DataFrame) -> pd.DataFrame:
    """Cost and excess of static dispatch of every second, by regime and scenario."""
    static = (frame["method"] == STATIC[0]) & (frame["settings"] == STATIC[1]) & (frame["period_s"] == 1)
    own = frame[static & (frame["latency_source"] == "timing") & (frame["kind"] == QUALITIES[0])]
    found = own.drop_duplicates(["regime", "scenario"], keep="last").set_index(["regime", "scenario"])
    names = {"objective": "static_objective", "max_excess_hz": "static_excess_hz"}
    return found[list(names)].rename(columns=names)


def _line(rows: pd.DataFrame) -> dict[str, Any]:
    """Means and maxima over the scenarios that were operated to their end; plans are counted over all."""
    done = rows.dropna(subset=["objective"])
    plans = max(int(rows["plans"].sum()), 1)
    return {
        "n": len(done),
        "failures": len(rows) - len(done),
        "increase_percent_mean": done["increase_percent"].mean(),
        "increase_percent_max": done["increase_percent"].max(),
        "over_known_percent_mean": done["over_known_percent"].mean(),
        "over_static_percent_mean": 100 * (done["objective"] / done["static_objective"] - 1).mean(),
        "static_excess_mhz_mean": 1e3 * done["static_excess_hz"].mean(),
        "max_excess_mhz_mean": 1e3 * done["max_excess_hz"].mean(),
        "max_excess_mhz_max": 1e3 * done["max_excess_hz"].max(),
        "unforeseen_mhz_mean": 1e3 * done["unforeseen_hz"].mean(),
        "share_outside": done["share_outside"].mean(),
        "slack_travel_pu": done["slack_travel_pu"].mean(),
        **{name: float(rows[name].sum()) / plans for name in ("late", "failed", "infeasible")},
    }


def own_latency(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method and period, at the latency of `timing.csv`, forecasts as announced."""
    return _lines(frame[(frame["latency_source"] == "timing") & (frame["kind"] == QUALITIES[0])], LOOP)


def sweeps(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method, latency and kind, of methods swept over latencies, their own included.

    Only scenarios count that were operated in all of a method's lines, so that these are about the same
    scenarios; what was operated on fewer than half as many scenarios as another latency that was asked for
    has none. A method's own latency may have been operated on all scenarios, and asks nothing of the others.
    Of several periods between plans, the one with most latencies counts.
    """
    frame = frame[frame["warm"].astype(bool)]
    parts = []
    for _, every in frame.groupby(GROUP, sort=False):
        period = every.groupby("period_s")["latency_s"].nunique().idxmax()
        rows = every[every["period_s"] == period]
        if rows.loc[rows["kind"] == QUALITIES[0], "latency_s"].nunique() < SWEPT:
            continue
        counts = rows.groupby(["latency_s", "kind"])["scenario"].transform("nunique")
        asked = rows["latency_source"] == "given"
        kept = rows[2 * counts >= (counts[asked] if asked.any() else counts).max()]
        lines = kept.groupby(["latency_s", "kind"]).ngroups
        everywhere = (
            kept.drop_duplicates(["latency_s", "kind", "scenario"])["scenario"].value_counts() == lines
        )
        parts.append(kept[kept["scenario"].map(everywhere).astype(bool)])
    swept = pd.concat(parts) if parts else frame.iloc[:0]
    return _lines(swept, [*LOOP, "kind"])


def crossed(lines: pd.DataFrame) -> pd.DataFrame:
    """Sweeps with a column of cost and of excess for each kind; one line per regime, method and latency."""
    if not len(lines):
        return lines
    index = [*GROUP, "latency_s"]
    wide = lines.pivot_table(
        index=index, columns="kind", values=["increase_percent_mean", "max_excess_mhz_mean"], sort=False
    )
    wide.columns = pd.Index(["_".join(pair) for pair in wide.columns])
    counts = lines.groupby(index)["n"].first()
    return wide.assign(n=counts).reset_index().sort_values(index, kind="stable", ignore_index=True)


def _lines(frame: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    made = [dict(zip(by, key, strict=True)) | _line(rows) for key, rows in frame.groupby(by, sort=False)]
    return line_table(made, [*by, *_line(frame)])
