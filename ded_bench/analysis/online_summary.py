"""What online.csv says: of every method at its own latency, and on islands beside today's practice."""

from __future__ import annotations

from typing import Any

import pandas as pd

from ded_bench.analysis import summary
from ded_bench.analysis.summary import GROUP, named, titled
from ded_bench.problem.scenario import QUALITIES
from ded_bench.results.online_results import ONLINE, OnlineResults

#: What rows of one line of a table share, besides the scenario.
LOOP = [*GROUP, "plant", "period_s", "latency_s", "warm"]
#: What others are set beside: static dispatch of every second, and on islands practice; method and settings.
STATIC, PRACTICE = ("ed", "every=1"), ("ed", "every=60")
#: Names of an island's numbers in lines, their columns in online.csv, and units of the former in the latter.
ISLAND = summary.ISLAND | {"cps1": ("cps1", 1.0), "increase_percent": ("increase_percent", 1.0)}
#: Own latencies that differ by so small a part share a line.
SAME = 0.01


def online_rows(results: OnlineResults, case: str) -> pd.DataFrame:
    """Rows of a case at methods' own latencies, forecasts as announced, in the order of the table.

    `static_objective` and `static_excess_hz` are those of static dispatch of every second.
    """
    frame = _predicted(results, case)
    own = (frame["latency_source"] == "timing") & (frame["forecast"] == QUALITIES[0])
    frame = frame[own].reset_index(drop=True)
    typical = frame.groupby([name for name in LOOP if name != "latency_s"])["latency_s"].transform("median")
    close = (frame["latency_s"] - typical).abs() <= SAME * typical
    frame["latency_s"] = frame["latency_s"].mask(close, typical)
    frame = frame.drop_duplicates([*LOOP, "scenario"], keep="last").reset_index(drop=True)
    is_static = (frame["method"] == STATIC[0]) & (frame["settings"] == STATIC[1])
    place = ["regime", "scenario", "plant"]
    found = frame[is_static & (frame["period_s"] == 1)].drop_duplicates(place, keep="last").set_index(place)
    names = {"objective": "static_objective", "max_excess_hz": "static_excess_hz"}
    return frame.join(found[list(names)].rename(columns=names), on=place)


def practice_rows(results: OnlineResults, case: str) -> pd.DataFrame:
    """Rows of an island that have its numbers or failed, with their `minutes`, and practice's beside them.

    `practice_objective`, `practice_mean_freq_max_hz` and `practice_agc_travel_pu` are those of static
    dispatch every 60 s in the same scenario under the same kind of forecast.
    """
    frame = _predicted(results, case)
    lasting = frame["plans"] * frame[["period_s", "latency_s"]].max(axis=1)
    minutes = (lasting / 60).groupby(frame["scenario"]).transform("max").round()
    alike = minutes.groupby(frame["scenario"].str.rstrip("0123456789")).transform("max")
    minutes = minutes.where(minutes > 0, alike)  # nobody came to the end
    frame["minutes"] = minutes.where(minutes > 0, minutes[minutes > 0].min())
    frame = frame[frame["cps1"].notna() | frame["objective"].isna()].reset_index(drop=True)
    place = ["regime", "scenario", "forecast", "plant"]
    is_practice = (frame["method"] == PRACTICE[0]) & (frame["settings"] == PRACTICE[1])
    practice = frame[is_practice & (frame["period_s"] == 60) & frame["warm"].astype(bool)]
    practice = practice.sort_values("latency_s", ascending=False, kind="stable")  # the least counts
    found = practice.drop_duplicates(place, keep="last").set_index(place)
    names = ["objective", "mean_freq_max_hz", "agc_travel_pu"]
    return frame.join(found[names].add_prefix("practice_"), on=place)


def practice_lines(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, kind of forecast, length, method, period and latency of `practice_rows`."""
    by = ["forecast", "minutes", *LOOP]
    made = [
        dict(zip(by, key, strict=True)) | _beside(rows)
        for key, rows in frame.groupby(by, sort=False, dropna=False)
    ]
    return _titled(pd.DataFrame(made, columns=[*by, *_beside(frame[:0])]))


def _beside(rows: pd.DataFrame) -> dict[str, Any]:
    """Means over the scenarios that were operated to their end, and over those where practice was, too."""
    done = rows.dropna(subset=["objective"])
    both = done.dropna(subset=["practice_objective"])
    found: dict[str, Any] = {"n": len(done), "failures": len(rows) - len(done)}
    found |= {name: scale * done[column].mean() for name, (column, scale) in ISLAND.items()}
    for name, column in (("peak", "mean_freq_max_hz"), ("travel", "agc_travel_pu")):
        found[f"{name}_ratio"] = both[f"practice_{column}"].mean() / both[column].mean()
    found["over_practice_percent"] = 100 * (both["objective"] / both["practice_objective"] - 1).mean()
    return found


def _predicted(results: OnlineResults, case: str) -> pd.DataFrame:
    """Rows of a case whose plans started from the state when they took effect, in the order of the table."""
    rows = list(results.table.rows.values())
    frame = named(ONLINE.frame(rows).assign(key=pd.Series([row.key for row in rows], dtype=object)))
    frame = frame[frame["predicted"].astype(bool) & (frame["case"] == case)]
    dated = frame.sort_values("date", kind="stable")  # only the newest model and policy of a line count
    is_new = dated["made"] == dated.groupby([*GROUP, "plant", "forecast"])["made"].transform("last")
    return dated[is_new].sort_index().reset_index(drop=True)


def own_latency(frame: pd.DataFrame) -> pd.DataFrame:
    """One line per regime, method, period and latency."""
    made = [dict(zip(LOOP, key, strict=True)) | _line(rows) for key, rows in frame.groupby(LOOP, sort=False)]
    return _titled(pd.DataFrame(made, columns=[*LOOP, *_line(frame)]))


def _titled(lines: pd.DataFrame) -> pd.DataFrame:
    """With a column `title`, which tells plant and start of a plan where these differ between lines."""
    told = titled(lines)
    if told["plant"].nunique() > 1:
        told["title"] += " on " + told["plant"]
    if told["warm"].nunique() > 1:
        told["title"] += [" warm" if warm else " cold" for warm in told["warm"]]
    return told


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
