"""The trade-off: mean gap against time per schedule, and who breaks limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter
from matplotlib.transforms import Bbox, BboxBase

from ded_bench.analysis.summary import title
from ded_bench.methods.options import DEFAULT
from ded_bench.report.figures.style import GREY, colour, legend_below, marker, new_figure, placed, plain
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

#: Gaps below this are drawn on a linear scale, larger ones on a logarithmic one, %.
LINEAR_GAP = 0.01
#: Where a word may stand beside its point: how it is aligned, and how far away, points.
SIDES = (
    *(("left", "bottom", (6, 2)), ("left", "top", (6, -2)), ("right", "top", (-6, -2))),
    *(("right", "bottom", (-6, 2)), ("center", "bottom", (0, 6)), ("center", "top", (0, -6))),
    *(("center", "bottom", (0, 15)), ("center", "top", (0, -15))),
)


def draw(sources: Sources) -> Iterator[Picture]:
    """One point per line of the tables, where there is a gap."""
    points = sources.outcome.dropna(subset=["gap_percent", "seconds"])
    points = points[points["regime"].isin(list(sources.case.regimes))]
    if not len(points):
        return
    grey = "; grey: the paper's numbers" if sources.paper else ""
    caption = (
        f"Mean gap to {sources.reference.title} against time per schedule; words name unusual settings and "
        "surrogates. Hollow: some schedules are infeasible; with an asterisk: timed under parallel load, not "
        f"by `ded-bench bench`{grey}. The vertical scale is linear within ±0.01 %."
    )
    paper, rows = sources.paper, []
    if paper:  # the gap of its reference is zero
        rows = [
            (regime, paper.methods[name][0], name, row.increase_percent or 0.0, row.solve_s)
            for regime, methods in paper.regimes.items()
            for name, row in methods.items()
        ]
    papers = pd.DataFrame(rows, columns=["regime", "method", "name", "gap_percent", "seconds"])
    yield placed(tradeoff_figure(points, sources.reference.title, papers), sources, "tradeoff", caption)


def tradeoff_figure(points: pd.DataFrame, reference: str, papers: pd.DataFrame) -> Figure:
    """One panel per regime. A method's lines share its colour and marker, and a thin line joins them.

    Args:
        points: see `summary.outcome`. Hollow markers: some schedules are infeasible.
        reference: its title.
        papers: `gap_percent` and `seconds` of a paper by regime, method and name; drawn in grey.
    """
    regimes = sorted(points["regime"].unique())
    with new_figure(0.5 + 2.9 * len(regimes)) as figure:
        panels = figure.subplots(len(regimes), 1, sharex=True, squeeze=False)[:, 0]
        for ax, regime in zip(panels, regimes, strict=True):
            for row in papers[papers["regime"] == regime].to_dict("records"):
                place = row["seconds"], row["gap_percent"]
                ax.plot(*place, marker=marker(row["method"]), color=GREY, linestyle="none")
                _word(ax, f"paper's {row['name']}", place, GREY)
            for method, family in points[points["regime"] == regime].groupby("method", sort=False):
                _draw_family(ax, str(method), family.sort_values(["seconds", "gap_percent"]))
            ax.set_xscale("log")
            ax.set_yscale("symlog", linthresh=LINEAR_GAP)
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.axhline(0.0, color=GREY, linewidth=0.8)
            ax.margins(0.1, 0.2)
            ax.set_ylabel(f"{regime}: gap to {plain(reference)} (%)")
        panels[-1].set_xlabel("time per schedule (s), median")
        legend_below(figure)
        figure.draw_without_rendering()  # sizes are known then
        for ax in panels:
            _keep_apart(ax)
    return figure


def _draw_family(ax: Axes, method: str, family: pd.DataFrame) -> None:
    """The points of one method, from fast to slow, and a word at each line but the usual one."""
    style: dict[str, Any] = {"color": colour(method), "marker": marker(method), "markersize": 6}
    x, y = family["seconds"], family["gap_percent"]
    ax.plot(x, y, linewidth=0.6, label=plain(title(method)), **style)
    hollow = family["correct_rate"] < 1
    ax.plot(x[hollow], y[hollow], linestyle="none", markerfacecolor="white", **style)
    for row in family.to_dict("records"):
        own = row["settings"] if row["settings"] != DEFAULT else row["model"]
        text = own * (row["title"] != title(method)) + " *" * (not row["alone"])
        _word(ax, text, (row["seconds"], row["gap_percent"]), colour(method))


def _word(ax: Axes, text: str, place: tuple[float, float], paint: str) -> None:
    """A word close to a point (see `_keep_apart`)."""
    ax.annotate(plain(text), place, (0, 0), textcoords="offset points", fontsize=6.5, color=paint)


def _keep_apart(ax: Axes) -> None:
    """Put each word on the side of its point where it covers least of other words, points and the frame."""
    places = [ax.transData.transform(np.asarray(line.get_xydata())) for line in ax.get_lines()]
    taken = [Bbox.from_extents(x - 6, y - 6, x + 6, y + 6) for x, y in np.concatenate(places)]
    for word in (child for child in ax.texts if isinstance(child, Annotation) and child.get_text()):
        boxes = {}
        for side in SIDES:
            word.set(ha=side[0], va=side[1])
            word.xyann = side[2]
            boxes[side] = word.get_window_extent()
        covered = {side: sum(_shared(box, other) for other in taken) for side, box in boxes.items()}
        beyond = {side: _shared(box, box) - _shared(box, ax.bbox) for side, box in boxes.items()}
        ha, va, offset = min(SIDES, key=lambda side: covered[side] + beyond[side])
        word.set(ha=ha, va=va)
        word.xyann = offset
        taken.append(boxes[ha, va, offset])


def _shared(one: BboxBase, other: BboxBase) -> float:
    """Area that two boxes share."""
    both = Bbox.intersection(one, other)
    return float(both.width * both.height) if both else 0.0
