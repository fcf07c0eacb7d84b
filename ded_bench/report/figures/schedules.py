"""Figures of schedules: powers, loads and slack power over time; the worst instances of a method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.analysis.summary import title
from ded_bench.problem.trajectory import Trajectory
from ded_bench.problem.case import Case
from ded_bench.report.figures.style import (
    BLACK,
    BUS_COLOURS,
    DASHES,
    GREY,
    RAD_TO_HZ,
    Shown,
    bounds,
    busiest,
    draw_line,
    envelope,
    legend_above,
    legend_below,
    new_figure,
    plain,
    thin,
    time_axis,
)


def schedule_figure(case: Case, heading: str, shown: Sequence[Shown]) -> Figure:
    """Generator powers with bounds, loads and slack power over time (paper, Figs. NO_cmp and TO_cmp).

    Of many generators and loads, those that move most are shown.

    Args:
        shown: trajectories of one instance, one per method.
    """
    chosen = busiest(*(s.trajectory.p_gen for s in shown))
    panels = len(chosen) + 2
    rows = -(-panels // 2)
    with new_figure(7.2, 0.7 + 2.1 * rows) as figure:
        axes = figure.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        handles: list[Line2D] = []
        for ax, j in zip(axes, chosen, strict=False):
            handles += [draw_line(ax, s, s.trajectory.t, s.trajectory.p_gen[:, j]) for s in shown]
            handles.append(bounds(ax, case.p_min[j], case.p_max[j]))
            ax.set_ylabel(f"$P_{{{case.generators[j]}}}$ (pu)")
        loads, slack = axes[panels - 2], axes[panels - 1]
        _draw_loads(loads, case, shown[0].trajectory)
        for s in shown:
            draw_line(slack, s, s.trajectory.t, s.trajectory.p_slack)
        slack.set_ylabel(f"slack $P_{{{case.slack}}}$ (pu)")
        for ax in axes[panels:]:
            ax.set_visible(False)
        time_axis(list(axes[:panels]), 2, shown[0].trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


def _draw_loads(ax: Axes, case: Case, run: Trajectory) -> None:
    """The loads that move most in colour, all others thin and grey."""
    named = busiest(run.p_load)
    others = [j for j in range(len(case.loads)) if j not in named]
    if others:
        ax.plot(*thin(run.t, run.p_load[:, others]), color=GREY, linewidth=0.4, alpha=0.6)
    for place, j in enumerate(named):
        ax.plot(
            *thin(run.t, run.p_load[:, j]),
            color=BUS_COLOURS[place % len(BUS_COLOURS)],
            dashes=DASHES[place % len(DASHES)] or (None, None),
            label=f"bus {case.loads[j]}",
        )
    ax.set_ylabel("loads (pu)")
    legend_above(ax, 3)


class Worst(NamedTuple):
    """One column of `worst_figure`: why it is there, and the runs of the method and of the reference."""

    reason: str
    shown: Shown
    reference: Shown | None


def worst_figure(case: Case, regime: str, heading: str, columns: Sequence[Worst]) -> Figure:
    """The worst instances of one method side by side: powers and frequencies, the reference's dashed.

    Of many generators, those whose powers move most are shown; the span of all frequencies is grey.
    """
    chosen = busiest(*(column.shown.trajectory.p_gen for column in columns))
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
            if len(chosen) < len(case.generators):
                bottom.fill_between(*envelope(t, omega), color=GREY, alpha=0.25, linewidth=0)
            for place, j in enumerate(chosen):
                paint = BUS_COLOURS[place % len(BUS_COLOURS)]
                for level in (case.p_min[j], case.p_max[j]):
                    top.axhline(level, color=paint, linestyle=":", linewidth=0.8)
                (line,) = top.plot(*thin(t, column.shown.trajectory.p_gen[:, j]), color=paint)
                handles[f"bus {case.generators[j]}"] = line
                bottom.plot(*thin(t, omega[:, j]), color=paint)
            if column.reference:
                run, dashed = (
                    column.reference.trajectory,
                    {"color": BLACK, "dashes": (4, 2), "linewidth": 0.9},
                )
                name = plain(title(column.reference.method, column.reference.settings))
                handles[name], *_ = top.plot(*thin(run.t, run.p_gen[:, chosen]), **dashed)
                bottom.plot(*thin(run.t, run.omega[:, chosen] * RAD_TO_HZ), **dashed)
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
