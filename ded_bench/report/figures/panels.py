"""Curves over time in panels: powers, loads, frequencies of trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ded_bench.analysis.online_summary import PRACTICE, STATIC
from ded_bench.analysis.summary import main_lines, records, titled, where
from ded_bench.files.arrays import read_arrays
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Array, Case
from ded_bench.problem.scenario import QUALITIES
from ded_bench.report.figures import style
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

RAD_TO_HZ = 1 / (2 * np.pi)
#: How many generators or loads a figure shows one by one.
FEW = 6
#: No printer or screen resolves more points of a curve.
POINTS = 1500


#: Times in s, (n,), values at them, and how these are drawn, the label included.
Curve = tuple[Array, Array, dict[str, Any]]


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
        look = style.look(self.method, self.place) if self.method else {"color": style.GREY}
        return self.t, values, {"label": style.plain(self.label), **look}


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
    for colour, dashes, j in zip(style.PALETTE, style.DASHES, busiest([one.p_load], FEW), strict=False):
        look = {"color": colour, "dashes": dashes, "linewidth": 0.9, "label": f"load {case.loads[j]}"}
        curves.append((one.t, one.p_load[:, j], look))
    return Panel("loads (pu)", curves)


def balance_panel(case: Case, regime: str, shown: Sequence[Shown]) -> Panel:
    """What takes up imbalances: slack power, pu; on an island the mean frequency, mHz."""
    if case.slack is None:
        mean = case.inertia / case.inertia.sum()
        limit = 1e3 * RAD_TO_HZ * float(case.bounds(regime).limit[0])
        return Panel(MEAN, [one.curve(1e3 * RAD_TO_HZ * one.omega @ mean) for one in shown], (limit, -limit))
    return Panel(f"slack $P_{{{case.slack}}}$ (pu)", [one.curve(one.p_slack) for one in shown])


def time_figure(heading: str, panels: Sequence[Panel], columns: int) -> Figure:
    """All panels, and one legend below."""
    rows = -(-len(panels) // columns)
    with style.new_figure(0.7 + (1.35 if columns == 1 else 1.8) * rows) as figure:
        axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for ax, panel in zip(axes, panels, strict=False):
            for t, values, look in panel.curves:
                step = max(1, len(t) // POINTS)
                ax.plot(t[::step], values[::step], **look)
            for level in panel.limits:
                ax.axhline(level, color="#444444", linestyle=":", linewidth=1.1, label="bound")
            ax.margins(x=0.0)
            ax.set_ylabel(panel.label)
        for ax in axes[max(len(panels) - columns, 0) : len(panels)]:
            ax.set_xlabel("time (s)")
            ax.tick_params(labelbottom=True)
        for ax in axes[len(panels) :]:
            ax.set_visible(False)
        style.legend_below(figure)
        figure.suptitle(style.plain(heading))
    return figure


def busiest(curves: Sequence[Array], count: int) -> list[int]:
    """The columns to show of many: those that move most, in their order; all if there are few.

    Args:
        curves: of shapes (n_points, n), such as one method's each; what counts is the largest range of any.
        count: at most so many.
    """
    ranges = np.max([np.ptp(values, axis=0) for values in curves], axis=0)
    return sorted(np.argsort(-ranges, kind="stable")[:count].tolist())


def draw_schedules(sources: Sources) -> Iterator[Picture]:
    """Of every regime that has a schedule (paper, Figs. NO_cmp, TO_cmp, freq_cmp)."""
    case = sources.case
    for regime in case.regimes:
        chosen = representative(sources, regime)
        shown = []
        for place, row in enumerate(records(chosen)):
            if run := sources.trajectory(row["key"]):
                arrays = run.t, run.p_set, run.omega, run.p_load, run.p_slack
                shown.append(Shown(row["method"], row["title"], place, *arrays))
        if not shown:
            continue
        heading = f"{chosen['instance'].iloc[0]}, {regime}"
        last = "mean frequency" if case.slack is None else "slack power"
        names = " and ".join(one.label for one in reversed(shown))
        caption = f"{names} on {heading}: set-points with bounds, loads, {last}; the gap is near the median"
        panels = [*power_panels(case, shown), load_panel(case, shown[0]), balance_panel(case, regime, shown)]
        yield style.placed(time_figure(heading, panels, 2), sources, f"schedule_{regime}", caption)
        if regime == sources.tightest:
            caption = f"Frequencies under {names} on {heading}; dotted: the regime's bounds."
            panels = frequency_panels(case, regime, shown, 4)
            yield style.placed(time_figure(heading, panels, 1), sources, f"frequencies_{regime}", caption)


def representative(sources: Sources, regime: str) -> pd.DataFrame:
    """Rows of the reference, if it was run, and a challenger on one instance; none without a kept schedule.

    Trained methods come before others, and the smaller the mean gap, the earlier. Of the instances whose
    schedules are kept, the one whose gap is nearest to the challenger's median is chosen.
    """
    rows = main_lines(sources.judged[sources.judged["regime"] == regime].dropna(subset=["objective"]))
    rows = rows.assign(gap_percent=rows["gap_percent"].fillna(0.0))
    kept = titled(where(rows, map(sources.has_schedule, rows["key"])))
    reference = kept[kept["method"] == sources.reference.method]
    gaps = rows.groupby("method")["gap_percent"]
    trained = {name for name, method in METHODS.items() if method.trainer}
    distance = gaps.agg(lambda gap: gap.abs().mean())
    for method in sorted(distance.index, key=lambda name: (name not in trained, distance[name], name)):
        pairs = kept[kept["method"] == method]
        if method != sources.reference.method and len(reference):
            pairs = pairs[pairs["instance"].isin(reference["instance"])]
        if (method != sources.reference.method or len(distance) == 1) and len(pairs):
            off = (pairs["gap_percent"] - gaps.get_group(method).median()).abs()
            both = pd.concat([reference, pairs]).drop_duplicates(["method", "instance"])
            return where(both, both["instance"] == pairs.loc[off.idxmin(), "instance"])
    return kept.iloc[:0]


#: Static dispatch that is drawn, method and settings; what moves most comes first, below the others.
STATICS = (PRACTICE, STATIC)
#: At most so many methods beside it, and generators, are drawn of a scenario.
METHODS_SHOWN, GENERATORS_SHOWN = 2, 2


def draw_scenario(sources: Sources) -> Iterator[Picture]:
    """Of the scenario that is chosen, if any is kept."""
    scenario, shown = shown_scenario(sources)
    if shown:
        case, heading = sources.case, f"{scenario}, {sources.tightest}"
        names = ", ".join(one.label for one in shown)
        last = "slack power" if case.slack else "secondary control (AGC)"
        caption = f"Scenario {heading}: loads, powers, frequencies and {last} under {names}."
        if not case.slack:
            caption += " Limits of powers are those of set-points: droop and AGC move deliveries beyond them."
        panels = [load_panel(case, shown[0]), *power_panels(case, shown, GENERATORS_SHOWN)]
        panels += frequency_panels(case, sources.tightest, shown, GENERATORS_SHOWN)
        agc = Panel("AGC (pu)", [one.curve(one.agc) for one in shown if one.agc is not None])
        panels.append(balance_panel(case, sources.tightest, shown) if case.slack else agc)
        yield style.placed(time_figure(heading, panels, 1), sources, "online_scenario", caption)


def shown_scenario(sources: Sources) -> tuple[str, list[Shown]]:
    """A scenario of the tightest regime and trajectories to show; none if none is kept.

    Of the longest scenarios with most lines, the one whose worst excess is the median; static dispatch, and
    of the other methods those of least excess, each with its best line.
    """
    files, rows = sources.results.paths, sources.online if sources.case.slack else sources.practice
    rows = rows[(rows["regime"] == sources.tightest) & (rows["forecast"] == QUALITIES[0])]
    rows = rows[rows["plant"] == sources.case.plant_name]
    rows = where(rows, (files.trajectory(key).is_file() for key in rows["key"]))
    if not len(rows):
        return "", []
    if "minutes" in rows:
        rows = rows[rows["minutes"] == rows["minutes"].max()]
    lines = rows.groupby("scenario")["key"].transform("size")
    excess = rows[lines == lines.max()].groupby("scenario")["max_excess_hz"].max()
    scenario = str(excess.sort_values(kind="stable").index[len(excess) // 2])
    one = titled(rows[rows["scenario"] == scenario]).sort_values("max_excess_hz", kind="stable")
    is_static = one["method"] == STATIC[0]
    statics = [one[is_static & (one["settings"] == settings)][:1] for _, settings in STATICS]
    chosen = pd.concat([*statics, one[~is_static].drop_duplicates("method")[:METHODS_SHOWN]])
    late = chosen["latency_s"].map(", latency {:.2g} s".format).where(chosen["latency_s"] > 0.0, "")
    places = zip(chosen["method"], chosen["settings"], chosen["title"] + late, strict=True)
    paths = dict(zip(places, map(files.trajectory, chosen["key"]), strict=True))
    hindsight = files.hindsight_trajectory(scenario, sources.tightest, sources.case.plant_name)
    if hindsight.is_file():  # first, below the others
        paths = {("", "", "hindsight"): hindsight} | paths
    read = [(*key, read_arrays(path)[0]) for key, path in paths.items()]
    return scenario, [  # static dispatch of every second has a colour of its own beside practice
        Shown(m if (m, settings) != STATIC else settings, label, i, **arrays)
        for i, (m, settings, label, arrays) in enumerate(read)
    ]
