"""Figures of schedules: powers, loads and slack power over time; the worst instances of a method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.evaluate.summary import title
from ded_bench.problem.case import Case
from ded_bench.report.figures.style import (
    BLACK,
    BUS_COLOURS,
    DASHES,
    RAD_TO_HZ,
    Shown,
    bounds,
    draw_line,
    legend_above,
    legend_below,
    new_figure,
    plain,
    thin,
    time_axis,
)


def schedule_figure(case: Case, heading: str, shown: Sequence[Shown]) -> Figure:
    """Generator powers with bounds, loads and slack power over time (paper, Figs. NO_cmp and TO_cmp).

    Args:
        shown: trajectories of one instance, one per method.
    """
    panels = len(case.generators) + 2
    rows = -(-panels // 2)
    with new_figure(7.2, 0.7 + 2.1 * rows) as figure:
        axes = figure.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        handles: list[Line2D] = []
        for j, bus in enumerate(case.generators):
            handles += [draw_line(axes[j], s, s.trajectory.t, s.trajectory.p_gen[:, j]) for s in shown]
            handles.append(bounds(axes[j], case.p_min[j], case.p_max[j]))
            axes[j].set_ylabel(f"$P_{{{bus}}}$ (pu)")
        loads, slack = axes[panels - 2], axes[panels - 1]
        for j, bus in enumerate(case.loads):
            loads.plot(
                *thin(shown[0].trajectory.t, shown[0].trajectory.p_load[:, j]),
                color=BUS_COLOURS[j % len(BUS_COLOURS)],
                dashes=DASHES[j % len(DASHES)] or (None, None),
                label=f"bus {bus}",
            )
        loads.set_ylabel("loads (pu)")
        legend_above(loads, len(case.loads))
        for s in shown:
            draw_line(slack, s, s.trajectory.t, s.trajectory.p_slack)
        slack.set_ylabel(f"slack $P_{{{case.slack}}}$ (pu)")
        for ax in axes[panels:]:
            ax.set_visible(False)
        time_axis(list(axes[:panels]), 2, shown[0].trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


class Worst(NamedTuple):
    """One column of `worst_figure`: why it is there, and the runs of the method and of the reference."""

    reason: str
    shown: Shown
    reference: Shown | None


def worst_figure(case: Case, regime: str, heading: str, columns: Sequence[Worst]) -> Figure:
    """The worst instances of one method side by side: powers and frequencies, the reference's dashed."""
    limit = case.regimes[regime].omega_hz
    width = 2.9 * max(len(columns), 4)
    with new_figure(width, 4.4) as figure:
        # Margins by hand: the automatic layout takes longer than all the drawing.
        figure.set_layout_engine(None)
        axes = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False)
        figure.subplots_adjust(0.75 / width, 0.19, 1 - 0.12 / width, 0.83, 0.1, 0.12)
        handles: dict[str, Line2D] = {}
        for column, (top, bottom) in zip(columns, axes.T, strict=True):
            t, omega = column.shown.trajectory.t, column.shown.trajectory.omega * RAD_TO_HZ
            for j, bus in enumerate(case.generators):
                paint = BUS_COLOURS[j % len(BUS_COLOURS)]
                for level in (case.p_min[j], case.p_max[j]):
                    top.axhline(level, color=paint, linestyle=":", linewidth=0.8)
                (line,) = top.plot(*thin(t, column.shown.trajectory.p_gen[:, j]), color=paint)
                handles[f"bus {bus}"] = line
                bottom.plot(*thin(t, omega[:, j]), color=paint)
            if column.reference:
                run, dashed = (
                    column.reference.trajectory,
                    {"color": BLACK, "dashes": (4, 2), "linewidth": 0.9},
                )
                name = plain(title(column.reference.method, column.reference.settings))
                handles[name], *_ = top.plot(*thin(run.t, run.p_gen), **dashed)
                bottom.plot(*thin(run.t, run.omega * RAD_TO_HZ), **dashed)
            handles["bound"] = bounds(bottom, limit, -limit)
            for ax in (top, bottom):
                ax.locator_params(nbins=4)  # ticks take longer than lines
            top.set_title(column.reason, fontsize=8)
            bottom.set_xlabel("time (s)")
            bottom.set_xlim(t[0], t[-1])
        axes[0, 0].set_ylabel("generator power (pu)")
        axes[1, 0].set_ylabel("frequency deviation (Hz)")
        figure.align_ylabels(axes[:, 0])
        figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=len(handles))
        figure.suptitle(heading)
    return figure
