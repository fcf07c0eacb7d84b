"""Curves over time in panels: powers, loads, frequencies of trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ded_bench.problem.case import Array, Case
from ded_bench.report.figures.style import DASHES, GREY, PALETTE, legend_below, look, new_figure, plain

RAD_TO_HZ = 1 / (2 * np.pi)
#: How many generators or loads a figure shows one by one.
FEW = 6
#: No printer or screen resolves more points of a curve.
POINTS = 1500


@dataclass(frozen=True, eq=False)
class Curve:
    """Values over time: (n,), or (n, m) for several that look alike."""

    t: Array  # s
    values: Array
    label: str
    style: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves that share axes, with dotted lines at limits."""

    label: str
    curves: list[Curve]
    limits: Sequence[float] = ()


@dataclass(frozen=True, eq=False)
class Shown:
    """Whose trajectory a figure shows, at which place, and its arrays; no method: hindsight's."""

    method: str
    label: str
    place: int
    t: Array  # (n,), s
    p_gen: Array  # (n, n_gen), pu
    omega: Array  # (n, n_gen), rad/s
    p_load: Array  # (n, n_load), pu
    p_slack: Array  # (n,), pu
    agc: Array | None = None  # (n,), pu

    def curve(self, values: Array) -> Curve:
        """Values over time in the method's colour."""
        style = look(self.method, self.place) if self.method else {"color": GREY}
        return Curve(self.t, values, self.label, style)


#: Labels of frequencies by what is bounded, of a generator or of all.
LABELS = {"omega": "$\\omega_{%s}$ (mHz)", "relative": "$\\omega_{%s}$ - mean (mHz)"}
MEAN = "mean $\\omega$ (mHz)"


def power_panels(case: Case, shown: Sequence[Shown], count: int = FEW) -> list[Panel]:
    """Powers with their bounds of the generators that move most, pu."""
    return [
        Panel(
            f"$P_{{{case.generators[j]}}}$ (pu)",
            [one.curve(one.p_gen[:, j]) for one in shown],
            (case.p_min[j], case.p_max[j]),
        )
        for j in busiest([one.p_gen for one in shown], count)
    ]


def frequency_panels(case: Case, regime: str, shown: Sequence[Shown], count: int = FEW) -> list[Panel]:
    """What the regime bounds of frequency deviations, those that move most, mHz.

    Every generator's; on an island their mean, and each one's difference from it.
    """
    bounds = case.bounds(regime)
    whole = np.flatnonzero(~bounds.at_end)
    outputs = [1e3 * RAD_TO_HZ * one.omega @ bounds.matrix[whole].T for one in shown]
    names = iter(case.generators)
    labels = [MEAN if bounds.kinds[j] == "mean" else LABELS[bounds.kinds[j]] % next(names) for j in whole]
    panels = []
    for j in busiest(outputs, count):
        limit = 1e3 * RAD_TO_HZ * float(bounds.limit[whole[j]])
        curves = [one.curve(values[:, j]) for one, values in zip(shown, outputs, strict=True)]
        panels.append(Panel(labels[j], curves, (limit, -limit)))
    return panels


def load_panel(case: Case, one: Shown) -> Panel:
    """The loads that move most, pu."""
    curves = []
    for colour, dashes, j in zip(PALETTE, DASHES, busiest([one.p_load], FEW), strict=False):
        style = {"color": colour, "dashes": dashes, "linewidth": 0.9}
        curves.append(Curve(one.t, one.p_load[:, j], f"load {case.loads[j]}", style))
    return Panel("loads (pu)", curves)


def balance_panel(case: Case, regime: str, shown: Sequence[Shown]) -> Panel:
    """What takes up imbalances: slack power, pu; on an island the mean frequency, mHz."""
    if case.slack is None:
        mean = case.inertia / case.inertia.sum()
        limit = 1e3 * RAD_TO_HZ * float(case.bounds(regime).limit[0])
        return Panel(MEAN, [one.curve(1e3 * RAD_TO_HZ * one.omega @ mean) for one in shown], (limit, -limit))
    return Panel(f"slack $P_{{{case.slack}}}$ (pu)", [one.curve(one.p_slack) for one in shown])


def agc_panel(shown: Sequence[Shown]) -> Panel:
    """What secondary control asks of all machines, pu."""
    return Panel("AGC (pu)", [one.curve(one.agc) for one in shown if one.agc is not None])


def time_figure(heading: str, panels: Sequence[Panel], columns: int) -> Figure:
    """All panels, and one legend below."""
    rows = -(-len(panels) // columns)
    with new_figure(0.7 + (1.35 if columns == 1 else 1.8) * rows) as figure:
        axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for ax, panel in zip(axes, panels, strict=False):
            for curve in panel.curves:
                step = max(1, len(curve.t) // POINTS)
                ax.plot(curve.t[::step], curve.values[::step], label=plain(curve.label), **curve.style)
            for level in panel.limits:
                ax.axhline(level, color="#444444", linestyle=":", linewidth=1.1, label="bound")
            ax.margins(x=0.0)
            ax.set_ylabel(panel.label)
        for ax in axes[max(len(panels) - columns, 0) : len(panels)]:
            ax.set_xlabel("time (s)")
            ax.tick_params(labelbottom=True)
        for ax in axes[len(panels) :]:
            ax.set_visible(False)
        legend_below(figure)
        figure.suptitle(plain(heading))
    return figure


def busiest(curves: Sequence[Array], count: int) -> list[int]:
    """The columns to show of many: those that move most, in their order; all if there are few.

    Args:
        curves: of shapes (n_points, n), such as one method's each; what counts is the largest range of any.
        count: at most so many.
    """
    ranges = np.max([np.ptp(values, axis=0) for values in curves], axis=0)
    return sorted(np.argsort(-ranges, kind="stable")[:count].tolist())
