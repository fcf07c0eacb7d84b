"""Figures of frequencies: under schedules, and predicted by a Koopman model against the swing equations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ded_bench.problem.trajectory import Trajectory
from ded_bench.problem.case import Array, Case
from ded_bench.report.figures.style import (
    BLACK,
    RAD_TO_HZ,
    VERMILION,
    Shown,
    bounds,
    busiest,
    colour,
    draw_line,
    envelope,
    legend_below,
    new_figure,
    thin,
    time_axis,
)

#: Generators whose frequencies have a panel of their own, if there are more.
SHOWN = 4


def frequency_figure(case: Case, regime: str, heading: str, shown: Sequence[Shown]) -> Figure:
    """Frequency deviation at every generator with the regime's bounds (paper, Fig. freq_cmp).

    Of many generators, those that move most are shown, under the span of all.
    """
    chosen = busiest(*(s.trajectory.omega for s in shown), count=SHOWN)
    spans = len(chosen) < len(case.generators)
    rows = len(chosen) + spans
    with new_figure(7.2, 0.8 + 1.7 * rows) as figure:
        axes = figure.subplots(rows, 1, sharex=True, squeeze=False).ravel()
        handles = []
        limit = case.regimes[regime].omega_hz
        for ax, j in zip(axes[spans:], chosen, strict=True):
            for s in shown:
                handles.append(draw_line(ax, s, s.trajectory.t, s.trajectory.omega[:, j] * RAD_TO_HZ))
            ax.set_ylabel(f"$\\omega_{{{case.generators[j]}}}$ (Hz)")
        if spans:
            axes[0].set_ylabel(f"all {len(case.generators)} (Hz)")
            for s in shown:
                t, least, largest = envelope(s.trajectory.t, s.trajectory.omega * RAD_TO_HZ)
                axes[0].fill_between(t, least, largest, color=colour(s.method), alpha=0.3, linewidth=0.6)
        for ax in axes:
            handles.append(bounds(ax, limit, -limit))
        time_axis(list(axes), 1, shown[0].trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


def koopman_figure(
    case: Case, regime: str, heading: str, trajectory: Trajectory, outputs: Array, name: str
) -> Figure:
    """Koopman rollout against the swing equations under one schedule (paper, Fig. KOswng_cmp).

    Of many generators, those on which the model errs most are shown.

    Args:
        outputs: the model's (ω, P_s) at the grid points, shape (n, n_gen + 1), rad/s and pu.
        name: the model's kind.
    """
    n_gen = len(case.generators)
    truth = np.column_stack([trajectory.omega * RAD_TO_HZ, trajectory.p_slack])
    model = outputs * np.array([*[RAD_TO_HZ] * n_gen, 1.0])
    labels = [*(f"$\\omega_{{{bus}}}$ (Hz)" for bus in case.generators), f"slack $P_{{{case.slack}}}$ (pu)"]
    chosen = [*busiest((model - truth)[:, :n_gen], count=SHOWN), n_gen]
    limit = case.regimes[regime].omega_hz
    with new_figure(7.2, 0.8 + 1.8 * len(chosen)) as figure:
        axes = figure.subplots(len(chosen), 2, sharex=True, width_ratios=(3, 2))
        handles = []
        for j, (left, right) in zip(chosen, axes, strict=True):
            handles += left.plot(*thin(trajectory.t, truth[:, j]), color=BLACK, label="swing equations")
            handles += left.plot(
                *thin(trajectory.t, model[:, j]),
                color=VERMILION,
                dashes=(4, 2),
                label=f"Koopman model ({name})",
            )
            if j < n_gen:
                handles.append(bounds(left, limit, -limit))
            left.set_ylabel(labels[j])
            right.plot(*thin(trajectory.t, model[:, j] - truth[:, j]), color=VERMILION, linewidth=1.1)
            right.axhline(0.0, color=BLACK, linewidth=0.8)
            right.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
            right.set_ylabel(f"Koopman − swing ({'Hz' if j < n_gen else 'pu'})")
        time_axis(list(axes.ravel()), 2, trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure
