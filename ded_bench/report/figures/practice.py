"""An island in operation: its frequency and secondary control under practice, static and dynamic plans."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import titled, where
from ded_bench.analysis.online_summary import PRACTICE, STATIC
from ded_bench.plants.score import AGC_COLUMN
from ded_bench.problem.case import Array
from ded_bench.report.figures.panels import RAD_TO_HZ, Curve, Panel, time_figure
from ded_bench.report.figures.style import PALETTE, Drawn
from ded_bench.report.sources import Sources
from ded_bench.results.online_results import read_trajectory

#: Static dispatch that is drawn, method and settings: practice twice, and every second; then one more method.
STATICS = ((PRACTICE[0], "every=300"), PRACTICE, STATIC)
#: Their colours, and that of the other method: what moves most is drawn first, in pale ones.
COLOURS = ("#bdbdbd", PALETTE[3], PALETTE[5], PALETTE[0])


def draw(sources: Sources) -> Iterator[Drawn]:
    """The longest scenario that most of them have operated, in the tightest regime."""
    rows = sources.practice
    if sources.case.slack is not None or not len(rows):
        return
    files = sources.results.paths
    rows = rows[(rows["regime"] == sources.tightest) & rows["objective"].notna()]
    rows = where(rows, (files.trajectory(key).is_file() for key in rows["key"]))
    if not len(rows):
        return
    rows = titled(rows)
    rows["place"] = [_place(*pair) for pair in zip(rows["method"], rows["settings"], strict=True)]
    rows["label"] = [
        f"{name}, every {s:g} s" for name, s in zip(rows["title"], rows["period_s"], strict=True)
    ]
    rows = rows[rows["place"] >= 0].sort_values("mean_freq_max_hz", kind="stable")
    rows = rows.drop_duplicates(["scenario", "forecast", "place"])
    counts = rows.groupby(["scenario", "forecast"]).agg(n=("place", "size"), minutes=("minutes", "max"))
    if not len(counts):
        return
    most = counts.sort_values(["n", "minutes"], kind="stable", ascending=False).index[0]
    one = rows[(rows["scenario"] == most[0]) & (rows["forecast"] == most[1])].sort_values("place")
    panels = _panels(sources, one, [read_trajectory(files.trajectory(key)) for key in one["key"]])
    caption = (
        f"Scenario {most[0]}, {sources.tightest}, forecasts {most[1]}: the island's mean frequency, its "
        "largest swing about it, and what secondary control (AGC) asks of all machines, under "
        + ", ".join(one["label"])
        + "."
    )
    yield Drawn("practice", caption, time_figure(f"{most[0]}, {sources.tightest}", panels, 1))


def _place(method: str, settings: str) -> int:
    """Where a line stands among those drawn; -1: nowhere."""
    if (method, settings) in STATICS:
        return STATICS.index((method, settings))
    return -1 if method == "ed" else len(STATICS)


def _panels(sources: Sources, rows: pd.DataFrame, kept: list[dict[str, Array]]) -> list[Panel]:
    """Mean frequency, swings, secondary control."""
    case = sources.case
    weight = case.inertia / case.inertia.sum()
    limits = 1e3 * RAD_TO_HZ * case.bounds(sources.tightest).limit
    mean, swing, agc = [], [], []
    for place, label, arrays in zip(rows["place"], rows["label"], kept, strict=True):
        t, hz = arrays["t"], 1e3 * RAD_TO_HZ * arrays["omega"]
        style = {"color": COLOURS[place], "linewidth": 0.9}
        mean.append(Curve(t, hz @ weight, label, style))
        about = np.abs(hz - (hz @ weight)[:, None]).max(axis=1)
        swing.append(Curve(t, about, label, style))
        if AGC_COLUMN in arrays:
            agc.append(Curve(t, arrays[AGC_COLUMN], label, style))
    return [
        Panel("mean frequency (mHz)", mean, (limits[0], -limits[0])),
        Panel("largest swing (mHz)", swing, (limits[1],)),
        Panel("AGC (pu)", agc),
    ]
