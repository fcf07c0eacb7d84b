"""Figures of the closed loop: what latency costs, one scenario under several methods, forecasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.analysis.online_summary import KINDS
from ded_bench.analysis.summary import title
from ded_bench.problem.case import Array, Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.scenario import Scenario
from ded_bench.report.figures.labels import Label, place_labels
from ded_bench.report.figures.style import (
    BLACK,
    BLUE,
    BUS_COLOURS,
    GREEN,
    GREY,
    ORANGE,
    RAD_TO_HZ,
    VERMILION,
    bounds,
    colour,
    dashes,
    legend_above,
    legend_below,
    marker,
    new_figure,
    plain,
    thin,
    time_axis,
)

#: Colours and dashes of what plans knew.
KIND_STYLE = dict(
    zip(
        KINDS,
        ((BLUE, ()), (GREEN, (5, 2)), (VERMILION, (1.5, 1.5)), (ORANGE, (6, 2, 1.5, 2)), (GREY, (3, 1.5))),
        strict=True,
    )
)
KIND_NAMES = {
    "announced": "forecast as announced",
    "perfect": "perfect forecast",
    "worse": "announcements four times as wrong",
    "persistence": "persistence",
    "present": "as announced, planned from the present state",
}
MEASURES = (
    ("increase_percent_mean", "cost over hindsight (%)", 1e-3),
    ("max_excess_mhz_mean", "largest excess (mHz)", 1e-3),
)
#: At most so many loads and generators are drawn: those that change most.
DRAWN = 3
#: Latencies below this, s, and values below those of MEASURES, lie on linear parts of the axes.
LINEAR_S = 0.01


def latency_figure(swept: pd.DataFrame, own: pd.DataFrame, heading: str) -> Figure:
    """Cost and excess against latency, a column per regime, with every method at its own latency.

    Args:
        swept: lines of one method (see `online_summary.sweeps`).
        own: lines at methods' own latencies (see `online_summary.own_latency`).
        heading: of the figure.
    """
    regimes = list(dict.fromkeys(swept["regime"]))
    with new_figure(max(7.2, 1.2 + 3.4 * len(regimes)), 6.6) as figure:
        axes = figure.subplots(2, len(regimes), sharex=True, squeeze=False)
        handles: list[Line2D] = []
        for (name, label, linear), row in zip(MEASURES, axes, strict=True):
            for regime, ax in zip(regimes, row, strict=True):
                handles += _sweep(ax, swept[swept["regime"] == regime], name)
                handles += _own(ax, own[own["regime"] == regime], name)
                ax.set_xscale("symlog", linthresh=LINEAR_S)
                ax.set_yscale("symlog", linthresh=linear)
                ax.set_xlim(left=-LINEAR_S / 5)
                values = [0.0, *(v for drawn in ax.get_lines() for v in np.atleast_1d(drawn.get_ydata()))]
                ax.set_ylim(3.0 * min(values) - linear / 10, 3.0 * max(values) + linear / 10)
            row[0].set_ylabel(label)
        for regime, top, bottom in zip(regimes, *axes, strict=True):
            top.set_title(regime)
            bottom.set_xlabel("latency (s)")
        legend_below(figure, handles, columns=2)
        figure.suptitle(heading)
        for (name, _, _), row in zip(MEASURES, axes, strict=True):
            for regime, ax in zip(regimes, row, strict=True):
                place_labels(figure, ax, _settings(own[own["regime"] == regime], name))
    return figure


def _settings(lines: pd.DataFrame, name: str) -> list[Label]:
    """Words for methods with several settings, whose points look alike."""
    several = lines.groupby("method")["settings"].transform("nunique") > 1
    return [
        Label(one["settings"], one["latency_s"], one[name], colour(one["method"]))
        for _, one in lines[several].iterrows()
    ]


def counted(lines: pd.DataFrame) -> str:
    """How many scenarios lines are about: one number, or all that occur."""
    return "/".join(map(str, sorted(set(lines["n"]))))


def _sweep(ax: Axes, lines: pd.DataFrame, name: str) -> list[Line2D]:
    handles = []
    for kind in KINDS:
        chosen = lines[lines["kind"] == kind].sort_values("latency_s")
        if len(chosen):
            shade, dash = KIND_STYLE[kind]
            handles += ax.plot(
                chosen["latency_s"],
                chosen[name],
                color=shade,
                dashes=dash or (None, None),
                marker=".",
                label=KIND_NAMES[kind],
            )
    return handles


def _own(ax: Axes, lines: pd.DataFrame, name: str) -> list[Line2D]:
    handles = []
    for _, one in lines.iterrows():
        label = f"{plain(title(one['method'], one['settings']))}{_how_often(one)}"
        handles += ax.plot(
            [one["latency_s"]],
            [one[name]],
            linestyle="none",
            marker=marker(one["method"]),
            markersize=7,
            color=colour(one["method"]),
            label=label,
            fillstyle="full" if one["period_s"] == 1.0 else "none",
            zorder=3,
        )
    return handles


def _how_often(one: pd.Series) -> str:
    """What to add to a method's name where its plans do not come every second."""
    if one["period_s"] == 1.0:
        return ""
    return ", as soon as due" if one["latency_s"] > one["period_s"] else f", every {one['period_s']:g} s"


class Operated(NamedTuple):
    """A scenario's trajectory as it is kept, and whose plans led to it."""

    method: str
    settings: str
    label: str
    arrays: Mapping[str, Array]


def scenario_figure(case: Case, regime: str, heading: str, shown: Sequence[Operated]) -> Figure:
    """Loads, generator powers, frequencies and slack power of one scenario under several methods."""
    first = shown[0].arrays
    loads = _liveliest([first["p_load"]])
    generators = _liveliest([one.arrays["omega"] for one in shown])
    n = len(generators)
    with new_figure(7.2, 1.4 + 1.35 * (2 + 2 * n)) as figure:
        axes = figure.subplots(2 + 2 * n, 1, sharex=True)
        handles: list[Line2D] = []
        for i, shade in zip(loads, BUS_COLOURS, strict=False):
            name = f"bus {case.loads[i]}"
            axes[0].plot(*thin(first["t"], -first["p_load"][:, i]), color=shade, label=name)
        legend_above(axes[0], DRAWN)
        axes[0].set_ylabel("loads (pu)")
        limit = 1e3 * case.regimes[regime].omega_hz
        for power, omega, j in zip(axes[1 : 1 + n], axes[1 + n : -1], generators, strict=True):
            for number, one in enumerate(shown):
                handles.append(_curve(power, one, number, one.arrays["p_gen"][:, j]))
                _curve(omega, one, number, one.arrays["omega"][:, j] * RAD_TO_HZ * 1e3)
            handles.append(bounds(omega, limit, -limit))
            power.set_ylabel(f"$P_{{{case.generators[j]}}}$ (pu)")
            omega.set_ylabel(f"$\\omega_{{{case.generators[j]}}}$ (mHz)")
        for number, one in enumerate(shown):
            _curve(axes[-1], one, number, one.arrays["p_slack"])
        axes[-1].set_ylabel("slack (pu)")
        time_axis(list(axes), 1, first["t"])
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


def _liveliest(values: Sequence[Array]) -> list[int]:
    """The DRAWN columns that range furthest in any of several arrays (n, n_columns), in their order."""
    ranges = np.max([np.ptp(array, axis=0) for array in values], axis=0)
    return sorted(np.argsort(-ranges, kind="stable")[:DRAWN].tolist())


def _curve(ax: Axes, one: Operated, number: int, values: Array) -> Line2D:
    shade = colour(one.method) if one.method else BLACK
    dash = dashes(one.method, number) if number and one.method else ()
    (drawn,) = ax.plot(
        *thin(one.arrays["t"], values),
        color=shade,
        dashes=dash or (None, None),
        linewidth=1.1,
        label=plain(one.label),
    )
    return drawn


def forecast_figure(case: Case, scenario: Scenario, heading: str) -> Figure:
    """Every load as it was, and as forecasts made at three moments saw it over the horizon."""
    horizon = case.sampling.horizon_s
    moments = np.round(np.array([0.2, 0.45, 0.7]) * scenario.duration_s, 1)
    truth = scenario.p_load(case)
    loads = _liveliest([truth])
    with new_figure(7.2, 1.0 + 1.8 * len(loads)) as figure:
        axes = figure.subplots(len(loads), 1, sharex=True, squeeze=False).ravel()
        handles: list[Line2D] = []
        for i, ax in zip(loads, axes, strict=True):
            handles += ax.plot(*thin(scenario.grid, -truth[:, i]), color=BLACK, label="what came")
            ax.set_ylabel(f"load {case.loads[i]} (pu)")
            for moment, shade in zip(moments, (BLUE, VERMILION, GREEN), strict=True):
                t = np.linspace(moment, moment + horizon, 601)
                seen = forecast(scenario, case, "announced", moment, moment + horizon).at(t)[:, i]
                label = f"forecast at {moment:g} s"
                handles += ax.plot(t, -seen, color=shade, dashes=(4, 1.5), label=label)
                ax.plot([moment], [-seen[0]], "o", color=shade, markersize=4)
        time_axis(list(axes), 1, scenario.grid)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure
