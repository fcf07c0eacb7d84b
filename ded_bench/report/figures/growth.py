"""Over several grids: time, memory and gap of each method against the number of generators."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ded_bench.report.figures.style import colour, legend_below, look, marker, new_figure, plain
from ded_bench.report.figures.tradeoff import LINEAR_GAP

#: Values on a logarithmic axis.
VALUES = (("solve_s", "time per schedule (s)"), ("peak_memory_mib", "peak memory (MiB)"))
GAP = ("gap_percent_mean", "mean gap (%)")


def growth_figure(points: pd.DataFrame) -> Figure:
    """Values of each method against the number of generators; hollow where some schedules are infeasible.

    Args:
        points: see `overview.points`.
    """
    values = (*VALUES, GAP)
    regimes = sorted(points["regime"].unique())
    sizes = points.drop_duplicates("case").sort_values("generators")
    with new_figure(0.7 + 2.3 * len(values)) as figure:
        axes = figure.subplots(len(values), len(regimes), sharex=True, sharey="row", squeeze=False)
        for (name, label), row in zip(values, axes, strict=True):
            row[0].set_ylabel(label)
            for ax, regime in zip(row, regimes, strict=True):
                known = points[points["regime"] == regime].dropna(subset=[name])
                for text, family in known.sort_values("generators").groupby("title", sort=False):
                    method = str(family["method"].iloc[0])
                    style = {"marker": marker(method), "markersize": 5}
                    ax.plot(
                        family["generators"], family[name], label=plain(str(text)), **style, **look(method)
                    )
                    hollow = family[family["correct_rate"] < 1]
                    style |= {"color": colour(method), "markerfacecolor": "white", "linestyle": "none"}
                    ax.plot(hollow["generators"], hollow[name], **style)
                ax.set_xscale("log")
                if name == GAP[0]:
                    ax.set_yscale("symlog", linthresh=LINEAR_GAP)
                    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                else:
                    ax.set_yscale("log")
        for ax, regime in zip(axes[0], regimes, strict=True):
            ax.set_title(regime)
        for ax in axes[-1]:
            ax.xaxis.set_major_locator(FixedLocator(sizes["generators"].tolist()))
            ax.xaxis.set_minor_locator(NullLocator())
            names = [f"{n}\n{case}" for n, case in zip(sizes["generators"], sizes["case"], strict=True)]
            ax.set_xticklabels(names, fontsize=6.5)
            ax.set_xlabel("generators besides the slack, and grid")
        legend_below(figure)
    return figure
