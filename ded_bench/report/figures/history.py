"""Trainings: losses and their terms over time, one figure per method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from ded_bench.analysis.lines import title
from ded_bench.report.figures.panels import Curve, Panel, time_figure
from ded_bench.report.figures.style import BLACK, DASHES, GREY, PALETTE, Drawn
from ded_bench.report.sources import Sources

LOSSES: Mapping[str, dict[str, Any]] = {
    "training": {"color": GREY, "linewidth": 0.8},
    "held out": {"color": BLACK},
}
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
    panels = []
    for name, history in histories.items():
        losses = [_curve(history, column, style) for column, style in LOSSES.items() if column in history]
        terms = [str(column) for column in history if column not in NO_TERMS]
        styles = ({"color": colour, "dashes": dashes} for dashes in DASHES for colour in PALETTE)
        drawn = [_curve(history, term, style) for term, style in zip(terms, styles, strict=False)]
        panels += [Panel("loss", losses, title=name), Panel("terms of the loss", drawn, log=True)]
    return time_figure("", panels, 2, time="training time (min)")


def _curve(history: pd.DataFrame, column: str, style: Mapping[str, Any]) -> Curve:
    taken = history[["seconds", column]].dropna()
    positive = taken[column].where((taken[column] > 0) | (column in LOSSES))
    return Curve(taken["seconds"].to_numpy() / 60, positive.to_numpy(), column, dict(style))
