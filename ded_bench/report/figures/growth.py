"""Figures over several grids: time, memory and gap of each method against the number of generators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ded_bench.report.figures.style import (
    GREY,
    colour,
    dashes,
    legend_below,
    marker,
    new_figure,
    plain,
)
from ded_bench.report.figures.tradeoff import LINEAR_GAP

#: Marks of values at which some schedules are infeasible.
_HOLLOW = "white"


def growth_figure(points: pd.DataFrame, values: Sequence[tuple[str, str]]) -> Figure:
    """Values of each method against the number of generators, both on logarithmic scales.

    Args:
        points: columns regime, case, generators, method, title, correct_rate, and the values.
        values: columns to draw, a row of panels each, with their labels.
    """
    regimes = sorted(points["regime"].unique())
    titles = points["title"].nunique()
    with new_figure(7.2, 0.7 + 2.6 * len(values) + 0.19 * -(-titles // 3)) as figure:
        axes = figure.subplots(len(values), len(regimes), sharex=True, sharey="row", squeeze=False)
        handles: list[Line2D] = []
        for row, (name, label) in zip(axes, values, strict=True):
            for ax, regime in zip(row, regimes, strict=True):
                handles += _curves(ax, points[points["regime"] == regime], name)
                ax.set_xscale("log")
                ax.set_yscale("log")
            row[0].set_ylabel(label)
        _finish(figure, axes, points, regimes, handles)
    return figure


def gap_figure(points: pd.DataFrame) -> Figure:
    """Mean gap of each method to its grid's reference against the number of generators; see `growth_figure`.

    Hollow markers: some schedules are infeasible.
    """
    regimes = sorted(points["regime"].unique())
    titles = points["title"].nunique()
    with new_figure(7.2, 3.3 + 0.19 * -(-titles // 3)) as figure:
        axes = figure.subplots(1, len(regimes), sharex=True, sharey="row", squeeze=False)
        handles: list[Line2D] = []
        for ax, regime in zip(axes[0], regimes, strict=True):
            handles += _curves(ax, points[points["regime"] == regime], "gap_percent_mean")
            ax.set_xscale("log")
            ax.set_yscale("symlog", linthresh=LINEAR_GAP)
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.axhline(0.0, color=GREY, linewidth=0.8)
        axes[0, 0].set_ylabel("mean gap to the reference (%)")
        _finish(figure, axes, points, regimes, handles)
    return figure


def _curves(ax: object, points: pd.DataFrame, name: str) -> list[Line2D]:
    lines: list[Line2D] = []
    for label, family in points.dropna(subset=[name]).groupby("title", sort=False):
        family = family.sort_values("generators")
        method = str(family["method"].iloc[0])
        paint = colour(method)
        lines += ax.plot(  # type: ignore[attr-defined]
            family["generators"],
            family[name],
            color=paint,
            marker=marker(method),
            markersize=6,
            dashes=dashes(method) or (None, None),
            linewidth=1.1,
            label=plain(str(label)),
        )
        hollow = family[family["correct_rate"] < 1]
        look = {"marker": marker(method), "color": paint, "markerfacecolor": _HOLLOW, "markersize": 6}
        ax.plot(hollow["generators"], hollow[name], linestyle="none", **look)  # type: ignore[attr-defined]
    return lines


def _finish(
    figure: Figure, axes: np.ndarray, points: pd.DataFrame, regimes: Sequence[str], handles: list[Line2D]
) -> None:
    """Grids on the lower axis, regimes on top, one legend."""
    sizes = points.drop_duplicates("case").sort_values("generators")
    for ax, regime in zip(axes[0], regimes, strict=True):
        ax.set_title(regime)
    for ax in axes[-1]:
        ax.xaxis.set_major_locator(FixedLocator(sizes["generators"].tolist()))
        ax.xaxis.set_minor_locator(NullLocator())
        names = [f"{n}\n{case}" for n, case in zip(sizes["generators"], sizes["case"], strict=True)]
        ax.set_xticklabels(names, fontsize=6.5)
        ax.set_xlabel("generators besides the slack, and grid")
    legend_below(figure, handles, columns=3)
