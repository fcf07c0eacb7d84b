"""Dolan-Moré performance profiles of time and objective."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ded_bench.analysis.lines import GROUP, main_lines
from ded_bench.analysis.summary import performance_profile, timed_rows
from ded_bench.report.figures.style import Drawn, legend_below, look, new_figure, plain
from ded_bench.report.sources import Sources

#: Smallest excess over the best that profiles resolve, %.
SMALLEST_EXCESS = 1e-4


def draw(sources: Sources) -> Iterator[Drawn]:
    """Of each method's main line."""
    usual = main_lines(sources.judged)
    times = performance_profile(timed_rows(usual, sources.calls), "solve_s")
    objectives = performance_profile(usual, "objective")
    if len(times) or len(objectives):
        caption = (
            "Performance profiles: share of the instances that a method was asked on which it is within a "
            "factor of the fastest (top; times of `ded-bench bench`), or within a percentage of the cheapest "
            "schedule (bottom). Only feasible schedules count; a method without any has no curve."
        )
        yield Drawn("profile", caption, profile_figure(times, objectives))


def profile_figure(times: pd.DataFrame, objectives: pd.DataFrame) -> Figure:
    """Profiles of solve time and objective, one column per regime.

    Args:
        times, objectives: see `summary.performance_profile`.
    """
    regimes = sorted({*times["regime"], *objectives["regime"]})
    with new_figure(4.4) as figure:
        axes = figure.subplots(2, len(regimes), sharey=True, sharex="row", squeeze=False)
        for column, regime in zip(axes.T, regimes, strict=True):
            excess = objectives.assign(ratio=np.maximum(100.0 * (objectives["ratio"] - 1.0), SMALLEST_EXCESS))
            for ax, profile in ((column[0], times), (column[1], excess)):
                _curves(ax, profile[profile["regime"] == regime], 2.0 * profile["ratio"].max())
            column[0].set_title(regime)
            column[0].set_xlabel("solve time over the fastest")
            column[1].set_xlabel("objective above the best method's (%)")
        for ax in axes[:, 0]:
            ax.set_ylabel("share of instances")
        legend_below(figure)
    return figure


def _curves(ax: Axes, profile: pd.DataFrame, end: float) -> None:
    """A step for each instance solved; flat up to the end."""
    for key, curve in profile.groupby(GROUP[1:], sort=False):
        x, y = curve["ratio"].to_numpy(dtype=float), curve["fraction"].to_numpy(dtype=float)
        ax.step(
            [x[0], *x, end],
            [0.0, *y, y[-1]],
            where="post",
            label=plain(str(curve["title"].iloc[0])),
            **look(str(key[0])),
        )
    ax.set_xscale("log")
    ax.set_ylim(-0.03, 1.03)
