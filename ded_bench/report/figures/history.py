"""Trainings: losses and their terms over time, one figure per method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.analysis.lines import title
from ded_bench.report.figures.style import (
    BLACK,
    DASHES,
    GREY,
    PALETTE,
    Drawn,
    legend_below,
    new_figure,
    plain,
)
from ded_bench.report.sources import Sources

LOSSES = {"training": {"color": GREY, "linewidth": 0.8}, "held out": {"color": BLACK, "linewidth": 1.4}}
#: Columns of a history that are no terms of its loss.
NO_TERMS = {"epoch", "step", "seconds", *LOSSES}


def draw(sources: Sources) -> Iterator[Drawn]:
    """Of every method that has histories."""
    tables: dict[str, dict[str, pd.DataFrame]] = {}
    for (method, name), table in sources.histories.items():
        tables.setdefault(method, {})[name] = table
    for method, histories in tables.items():
        trained = title(method) if method else "unknown methods"
        caption = f"Loss of each policy of {trained} over its training time; right: its terms."
        yield Drawn(f"training_{method or 'other'}", caption, history_figure(histories))


def history_figure(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Losses over time on the left, the terms of the loss on the right; a row per policy.

    Args:
        histories: by name of the policy; columns as `methods.training_record` describes them.
    """
    with new_figure(0.6 + 1.9 * len(histories)) as figure:
        axes = figure.subplots(len(histories), 2, squeeze=False)
        handles: list[Line2D] = []
        for (name, history), (left, right) in zip(histories.items(), axes, strict=True):
            for column, style in LOSSES.items():
                if column in history:
                    handles += _curve(left, history, column, **style)
            for i, term in enumerate(str(name) for name in history if name not in NO_TERMS):
                style = {
                    "color": PALETTE[i % len(PALETTE)],
                    "dashes": DASHES[i % len(DASHES)],
                }
                handles += _curve(right, history, term, **style)
                right.set_yscale("log")
            left.set_title(plain(name), fontsize=8.5, loc="left")
            left.set_ylabel("loss")
            right.set_ylabel("terms of the loss")
            right.set_visible(bool(right.get_lines()))
        for ax in axes[-1]:
            ax.set_xlabel("training time (min)")
        legend_below(figure, handles, columns=4)
    return figure


def _curve(ax: Axes, history: pd.DataFrame, column: str, **style: object) -> list[Line2D]:
    taken = history[["seconds", column]].dropna()
    values = taken[column].where(taken[column] > 0) if column not in LOSSES else taken[column]
    drawn: list[Line2D] = ax.plot(taken["seconds"] / 60, values, label=plain(column), **style)  # type: ignore[arg-type]
    return drawn if len(taken) else []
