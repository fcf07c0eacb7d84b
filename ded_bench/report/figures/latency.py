"""The closed loop: methods at their own latency, and one scenario under several of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ded_bench.analysis.lines import titled, where
from ded_bench.analysis.online_summary import STATIC, own_latency
from ded_bench.report.figures.panels import (
    Shown,
    balance_panel,
    frequency_panels,
    load_panel,
    power_panels,
    time_figure,
)
from ded_bench.report.figures.style import Drawn, colour, legend_below, marker, new_figure, plain
from ded_bench.report.sources import Sources
from ded_bench.results.online_results import OnlineFiles, read_trajectory

#: Name of a column, its label, and up to where its axis is linear.
MEASURES = (
    ("increase_percent_mean", "cost over hindsight (%)", 1e-3),
    ("max_excess_mhz_mean", "largest excess (mHz)", 1e-3),
)
#: Latencies below this lie on a linear part of the axis, s.
LINEAR_S = 0.01
#: At most so many methods and generators are drawn of a scenario.
METHODS_SHOWN, GENERATORS_SHOWN = 3, 3


def draw(sources: Sources) -> Iterator[Drawn]:
    """Cost and excess of all methods against latency, and one scenario."""
    own = titled(own_latency(sources.online))
    if len(own):
        caption = "Methods at their own latency, over all scenarios that they operated."
        yield Drawn("online_latency", caption, latency_figure(own, sources.case.id))
    scenario, shown = shown_scenario(sources)
    if shown:
        case, heading = sources.case, f"{scenario}, {sources.tightest}"
        names = ", ".join(one.label for one in shown)
        caption = f"Scenario {heading}: loads, powers, frequencies and slack power under {names}."
        panels = [load_panel(case, shown[0]), *power_panels(case, shown, GENERATORS_SHOWN)]
        panels += frequency_panels(case, sources.tightest, shown, GENERATORS_SHOWN)
        panels.append(balance_panel(case, sources.tightest, shown))
        yield Drawn("online_scenario", caption, time_figure(heading, panels, 1))


def latency_figure(own: pd.DataFrame, heading: str) -> Figure:
    """Cost and excess against latency, a column per regime.

    Args:
        own: lines at methods' own latencies (see `online_summary.own_latency`), with their titles.
        heading: above the figure.
    """
    regimes = list(dict.fromkeys(own["regime"]))
    with new_figure(5.4) as figure:
        axes = figure.subplots(2, len(regimes), sharex=True, squeeze=False)
        for (name, label, linear), row in zip(MEASURES, axes, strict=True):
            for regime, ax in zip(regimes, row, strict=True):
                _points(ax, own[own["regime"] == regime], name)
                ax.set_xscale("symlog", linthresh=LINEAR_S)
                ax.set_yscale("symlog", linthresh=linear)
                ax.set_xlim(left=-LINEAR_S / 5)
            row[0].set_ylabel(label)
        for regime, top, bottom in zip(regimes, *axes, strict=True):
            top.set_title(regime)
            bottom.set_xlabel("latency (s)")
        legend_below(figure, columns=2)
        figure.suptitle(plain(heading))
    return figure


def _points(ax: Axes, own: pd.DataFrame, name: str) -> None:
    """Methods at their own latency; hollow where plans do not come every second."""
    for one in own.to_dict("records"):
        often = "" if one["period_s"] == 1.0 else f", every {one['period_s']:g} s"
        style: dict[str, Any] = {"marker": marker(one["method"]), "color": colour(one["method"])}
        style |= {"label": plain(one["title"] + often), "fillstyle": "none" if often else "full"}
        ax.plot([one["latency_s"]], [one[name]], linestyle="none", zorder=3, **style)


def shown_scenario(sources: Sources) -> tuple[str, list[Shown]]:
    """A scenario of the tightest regime and trajectories to show; none if none is kept.

    Of the scenarios with most methods, the one whose worst excess is the median; static dispatch of every
    second, and of the other methods those of least excess, each with its best line.
    """
    files, rows = OnlineFiles(sources.folder), sources.online
    rows = rows[(rows["regime"] == sources.tightest) & (rows["period_s"] == 1)]
    rows = where(rows, (files.trajectory(key).is_file() for key in rows["key"]))
    if not len(rows):
        return "", []
    methods = rows.groupby("scenario")["method"].transform("nunique")
    excess = rows[methods == methods.max()].groupby("scenario")["max_excess_hz"].max()
    scenario = str(excess.sort_values(kind="stable").index[len(excess) // 2])
    one = titled(rows[rows["scenario"] == scenario]).sort_values("max_excess_hz", kind="stable")
    static = (one["method"] == STATIC[0]) & (one["settings"] == STATIC[1])
    chosen = pd.concat([one[static], one[~static].drop_duplicates("method")])[:METHODS_SHOWN]
    paths = {
        (row["method"], f"{row['title']}, {row['latency_s']:.2g} s"): files.trajectory(row["key"])
        for row in chosen.to_dict("records")
    }
    hindsight = files.hindsight_trajectory(scenario, sources.tightest)
    if hindsight.is_file():  # first, below the others
        paths = {("", "hindsight"): hindsight} | paths
    read = [(*key, read_trajectory(path)) for key, path in paths.items()]
    return scenario, [Shown(m, label, i, **arrays) for i, (m, label, arrays) in enumerate(read)]
