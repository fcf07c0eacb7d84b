"""Figures of methods against each other: gap against time, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from ded_bench.analysis.summary import GROUP, natural, title
from ded_bench.problem.case import Array
from ded_bench.report.figures.labels import Label, place_labels
from ded_bench.report.figures.style import GREY, colour, dashes, legend_below, marker, new_figure, plain

#: Gaps below this are drawn on a linear scale, larger ones on a logarithmic one, %.
LINEAR_GAP = 0.01
#: Smallest excess over the best that profiles resolve, %.
SMALLEST_EXCESS = 1e-4
#: Sizes of default settings' markers, from the first method to the last: what lies below shows its rim.
LARGEST, SMALLEST = 9.0, 5.5
#: Fill of the paper's points.
PAPERS = "#d9d9d9"


def tradeoff_figure(points: pd.DataFrame, reference: str, papers: pd.DataFrame) -> Figure:
    """Mean gap to the reference against time per schedule, one panel per regime.

    A method's settings share its colour and marker; a thin line joins them and a word names each but the
    default.

    Args:
        points: see `summary.tradeoff`. Hollow markers: some schedules are infeasible.
        reference: its title.
        papers: the paper's points, drawn in grey: columns regime, method (ours), name (the paper's),
            gap_percent and seconds.
    """
    points = points.dropna(subset=["gap_percent"])
    regimes = sorted(points["regime"].unique())
    methods = list(points["method"].unique())
    sizes = dict(zip(methods, np.linspace(LARGEST, SMALLEST, len(methods)), strict=True))
    rows = -(-(len(methods) + 2) // 3)
    with new_figure(5.6, 0.2 + 2.35 * max(len(regimes), 1) + 0.19 * rows) as figure:
        panels = figure.subplots(max(len(regimes), 1), 1, sharex=True, squeeze=False)[:, 0]
        handles: dict[str, Line2D] = {}  # by method: one that only one regime timed alone has one entry
        alone = points.groupby("method")["alone"].all()
        labels: dict[Axes, list[Label]] = {}
        for ax, regime in zip(panels, regimes, strict=False):
            labels[ax] = _draw_papers(ax, papers[papers["regime"] == regime])
            for key, family in points[points["regime"] == regime].groupby("method", sort=False):
                method = str(key)
                style: dict[str, Any] = {"marker": marker(method), "color": colour(method)}
                labels[ax] += _draw_family(
                    ax, family.sort_values(["seconds", "gap_percent"]), style, sizes[method]
                )
                label = plain(title(method) + ("" if alone[method] else " *"))
                handles[method] = Line2D([], [], linestyle="none", markersize=6, label=label, **style)
            ax.set_xscale("log")
            ax.set_yscale("symlog", linthresh=LINEAR_GAP)
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.axhline(0.0, color=GREY, linewidth=0.8)
            ax.margins(0.08, 0.12)
            ax.set_ylabel(f"{regime}: gap to {plain(reference)} (%)")
        panels[-1].set_xlabel("time per schedule (s), median")
        marks = _legend_marks(bool((points["correct_rate"] < 1).any()), len(papers) > 0)
        legend_below(figure, [*handles.values(), *marks], columns=3)
        for ax, found in labels.items():
            place_labels(figure, ax, found)
    return figure


def _legend_marks(hollow: bool, papers: bool) -> list[Line2D]:
    """What hollow and grey markers mean, where there are any."""
    mark: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 6, "color": GREY}
    found = [Line2D([], [], markerfacecolor="white", label="hollow: some infeasible", **mark)] * hollow
    return found + [Line2D([], [], markerfacecolor=PAPERS, label="grey: the paper's", **mark)] * papers


def _draw_papers(ax: Axes, papers: pd.DataFrame) -> list[Label]:
    """The paper's points, and what to write beside them."""
    labels = []
    for row in papers.to_dict("records"):
        method, place = str(row["method"]), (float(row["seconds"]), float(row["gap_percent"]))
        look: dict[str, Any] = {"marker": marker(method), "color": colour(method), "linestyle": "none"}
        ax.plot(*place, markerfacecolor=PAPERS, markersize=5, markeredgewidth=0.8, zorder=4, **look)
        labels.append(Label(f"paper's {row['name']}", *place, GREY))
    return labels


def _draw_family(ax: Axes, family: pd.DataFrame, style: Mapping[str, Any], size: float) -> list[Label]:
    """The points of one method, from fast to slow; returns the names of its settings."""
    if len(family) > 1:
        ax.plot(family["seconds"], family["gap_percent"], color=style["color"], linewidth=0.7, alpha=0.6)
    labels = []
    for row in family.to_dict("records"):
        usual = row["settings"] == "default"
        face = style["color"] if row["correct_rate"] == 1 else "white"
        look: dict[str, Any] = {
            "markersize": size if usual else 4.5,
            "markeredgewidth": 1.3 if usual else 1.0,
        }
        place = float(row["seconds"]), float(row["gap_percent"])
        ax.plot(*place, linestyle="none", markerfacecolor=face, **look, **style)
        if not usual:
            slug = str(row["settings"]).removeprefix("default-")
            labels.append(Label(f"{slug}{'' if row['alone'] else ' *'}", *place, style["color"]))
    return labels


def profile_figure(times: pd.DataFrame, objectives: pd.DataFrame) -> Figure:
    """Dolan-Moré profiles of solve time and objective, one column per regime.

    Args:
        times, objectives: see `metrics.performance_profile`.
    """
    regimes = sorted({*times["regime"], *objectives["regime"]})
    drawn = pd.concat([times, objectives])[["method", "settings", "title"]].drop_duplicates()
    variants = {
        str(method): ["default", *sorted({*slugs} - {"default"}, key=natural)]
        for method, slugs in drawn.groupby("method")["settings"]
    }
    titles = drawn["title"].nunique()
    with new_figure(7.2, 4.6 + 0.2 * -(-titles // 3)) as figure:
        axes = figure.subplots(2, max(len(regimes), 1), sharey=True, sharex="row", squeeze=False)
        handles: list[Line2D] = []
        for column, regime in zip(axes.T, regimes, strict=False):
            for ax, profile, is_gap in ((column[0], times, False), (column[1], objectives, True)):
                part = profile[profile["regime"] == regime]
                limit = _last(profile["ratio"], is_gap)
                for key, curve in part.groupby(GROUP[1:], sort=False):
                    method, settings = (str(part) for part in key)
                    variant = variants[method].index(settings)
                    ratio = np.array(curve["ratio"], dtype=float)
                    x = _excess(ratio) if is_gap else ratio
                    x = np.concatenate([x[:1], x, [limit]])
                    y = np.concatenate([[0.0], curve["fraction"], curve["fraction"].iloc[-1:]])
                    handles += ax.step(
                        x,
                        y,
                        where="post",
                        color=colour(method),
                        dashes=dashes(method, variant) or (None, None),
                        linewidth=1.4 if settings == "default" else 0.9,
                        label=plain(str(curve["title"].iloc[0])),
                    )
                ax.set_xscale("log")
                ax.set_ylim(-0.03, 1.03)
                ax.set_xlabel(
                    "objective above the best method's (%)" if is_gap else "solve time over the fastest"
                )
            column[0].set_title(regime)
        for ax in axes[:, 0]:
            ax.set_ylabel("share of instances")
        legend_below(figure, handles, columns=3)
    return figure


def _excess(ratio: Array) -> Array:
    return np.maximum(100.0 * (ratio - 1.0), SMALLEST_EXCESS)


def _last(ratio: pd.Series[float], is_gap: bool) -> float:
    values = np.array(ratio, dtype=float)
    if is_gap:
        return 2.0 * float(_excess(values).max(initial=10 * SMALLEST_EXCESS))
    return 2.0 * float(values.max(initial=2.0))
