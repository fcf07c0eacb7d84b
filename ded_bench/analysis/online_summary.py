"""What online.csv says: every method at its own latency, and sweeps over latency, forecast and state."""

from __future__ import annotations

import pandas as pd

from ded_bench.problem.ac_case import TRUTHS
from ded_bench.problem.forecast import QUALITIES
from ded_bench.results.online_results import ONLINE, OnlineResults

#: What rows of one line of a table share, besides the scenario.
LOOP = ["regime", "method", "settings", "period_s", "latency_s", "forecast", "predicted", "warm"]
RUN = ["regime", "method", "settings"]
#: The operator's practice that others are set beside.
STATIC = ("ed", "1s")
#: A method with so many latencies at one forecast was swept.
SWEPT = 3
#: Own latencies that differ by so small a part share a line.
SAME = 0.01
#: Forecasts of a sweep, and plans from the present state under announcements.
KINDS = (*QUALITIES, "present")


def online_rows(results: OnlineResults, case: str, truth: str = TRUTHS[0]) -> pd.DataFrame:
    """Rows of a case on one network in the order of the table; `kind` is the forecast, or `present`.

    `over_known_percent` is the cost over the same method's on the scenario with a perfect forecast and no
    latency, %; `static_objective` and `static_excess_hz` are those of static dispatch of every second.
    """
    rows = (row for row in results.table.rows.values() if row.case == case and row.truth == truth)
    frame = ONLINE.frame(rows)
    announced = frame["forecast"] == QUALITIES[0]
    frame["kind"] = frame["forecast"].where(frame["predicted"].astype(bool), "present")
    frame = frame[frame["predicted"].astype(bool) | announced].reset_index(drop=True)
    frame["latency_s"] = _shared_latency(frame)
    known = frame[(frame["kind"] == "perfect") & (frame["latency_s"] == 0) & frame["warm"].astype(bool)]
    best = known.set_index([*RUN, "scenario"])["objective"]
    best = best[~best.index.duplicated()]
    same = best.reindex(pd.MultiIndex.from_frame(frame[[*RUN, "scenario"]])).to_numpy()
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


def line(rows: pd.DataFrame) -> dict[str, object]:
    """One line of a table from the rows of several scenarios.

    Means and maxima over the scenarios that were operated to their end; plans are counted over all.
    """
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
        "mean_excess_mhz": 1e3 * done["mean_excess_hz"].mean(),
        "share_outside": done["share_outside"].mean(),
        "slack_travel_pu": done["slack_travel_pu"].mean(),
        "ramp_violation_max": done["ramp_violation"].max(),
        "bound_violation_max": done["bound_violation"].max(),
        **{name: float(rows[name].sum()) / plans for name in ("late", "failed", "infeasible")},
    }


def own_latency(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method and period, at the latency of `timing.csv`, forecasts as announced."""
    own = frame[(frame["latency_source"] == "timing") & (frame["kind"] == QUALITIES[0])]
    return _lines(own, LOOP)


def operated(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per way of operating: regime, method, settings and the options of the loop."""
    return _lines(frame, LOOP)


def sweeps(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method, latency and kind, of methods swept over latencies, their own included.

    Only scenarios count that were operated in all of a method's lines, so that these are about the same
    scenarios; what was operated on fewer than half as many scenarios as another latency that was asked for
    has none. A method's own latency may have been operated on all scenarios, and asks nothing of the others.
    Of several periods between plans, the one with most latencies counts.
    """
    frame = frame[frame["warm"].astype(bool)]
    parts = []
    for _, every in frame.groupby(RUN, sort=False):
        period = every.groupby("period_s")["latency_s"].nunique().idxmax()
        rows = every[every["period_s"] == period]
        announced = rows[rows["kind"] == QUALITIES[0]]
        if announced["latency_s"].nunique() < SWEPT:
            continue
        scenarios = [set(line["scenario"]) for _, line in rows.groupby(["latency_s", "kind"])]
        asked = rows[rows["latency_source"] == "given"] if "given" in set(rows["latency_source"]) else rows
        most = asked.groupby(["latency_s", "kind"])["scenario"].nunique().max()
        common = set.intersection(*(some for some in scenarios if 2 * len(some) >= most))
        kept = rows.groupby(["latency_s", "kind"])["scenario"].transform("nunique") * 2 >= most
        parts.append(rows[kept & rows["scenario"].isin(common)])
    swept = pd.concat(parts) if parts else frame.iloc[:0]
    return _lines(swept, [*LOOP, "kind"])


def crossed(lines: pd.DataFrame) -> pd.DataFrame:
    """Sweeps with a column of cost and of excess for each kind; one line per regime, method and latency."""
    if not len(lines):
        return lines
    index = [*RUN, "latency_s"]
    wide = lines.pivot_table(
        index=index, columns="kind", values=["increase_percent_mean", "max_excess_mhz_mean"], sort=False
    )
    wide.columns = pd.Index(["_".join(pair) for pair in wide.columns])
    counts = lines.groupby(index)["n"].first()
    return wide.assign(n=counts).reset_index().sort_values(index, kind="stable", ignore_index=True)


def _lines(frame: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    made = [dict(zip(by, key, strict=True)) | line(rows) for key, rows in frame.groupby(by, sort=False)]
    return pd.DataFrame(made, columns=None if made else [*by, *line(frame)])
