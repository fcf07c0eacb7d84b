"""Figures of trainings: losses and their terms over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.report.figures.style import (
    BLACK,
    BUS_COLOURS,
    DASHES,
    GREY,
    legend_below,
    new_figure,
    plain,
)

LOSSES = ("training", "held out")
#: A term whose largest value is less than this times its smallest is a straight line.
STILL = 1.2


def history_figure(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Training losses of policies over time on the left, what else changes in their histories on the right.

    Args:
        histories: by name of the policy; columns as `methods.training_record` describes them.
    """
    rows = max(len(histories), 1)
    terms = {name: moving_terms(history) for name, history in histories.items()}
    columns = 2 if any(terms.values()) else 1
    with new_figure(7.2 if columns == 2 else 4.4, 0.6 + 2.1 * rows) as figure:
        axes = figure.subplots(rows, columns, squeeze=False)
        handles: list[Line2D] = []
        for (name, history), panels in zip(histories.items(), axes, strict=False):
            minutes = history["seconds"] / 60
            left = panels[0]
            for column, paint, width in (("training", GREY, 0.8), ("held out", BLACK, 1.4)):
                taken = history.get(column, pd.Series(dtype=float)).dropna()
                if len(taken):
                    handles += left.plot(
                        minutes[taken.index], taken, color=paint, label=column, linewidth=width
                    )
            left.set_title(plain(name), fontsize=8.5, loc="left")
            left.set_ylabel("loss")
            if columns == 2:
                handles += _draw_terms(panels[1], minutes, history[terms[name]])
        for ax in axes[-1]:
            ax.set_xlabel("training time (min)")
        for ax in axes.ravel():
            ax.set_visible(bool(ax.get_lines()))
        if handles:
            legend_below(figure, handles, columns=4)
    return figure


def moving_terms(history: pd.DataFrame) -> list[str]:
    """The further columns of a history that change by a factor of at least STILL, and are not its loss.

    Others, such as the cost that dominates the loss, would be a straight line or the loss drawn twice.
    """
    known = ("epoch", "step", "seconds", *LOSSES)
    losses = [history[name] for name in LOSSES if name in history]
    found = []
    for name in (str(name) for name in history if name not in known):
        values = history[name].dropna()
        values = values[values > 0]
        same = any(np.allclose(history[name], loss, rtol=1e-4, equal_nan=True) for loss in losses)
        if len(values) and not same and values.max() >= STILL * values.min():
            found.append(name)
    return found


def _draw_terms(ax: Axes, minutes: pd.Series[float], terms: pd.DataFrame) -> list[Line2D]:
    lines: list[Line2D] = []
    for i, term in enumerate(terms):
        taken = terms[term].dropna()
        lines += ax.plot(
            minutes[taken.index],
            taken.where(taken > 0),
            color=BUS_COLOURS[i % len(BUS_COLOURS)],
            dashes=DASHES[i % len(DASHES)] or (None, None),
            label=plain(str(term)),
            linewidth=1.1,
        )
    ax.set_yscale("log")
    ax.set_ylabel("terms of the loss")
    return lines
