"""Figures of numbers: trade-off, profiles, training, sampled parameters, the Koopman models' quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from ded_bench.evaluate.summary import GROUP, natural, title
from ded_bench.koopman.model import Koopman
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.report.figures.style import (
    BLACK,
    BLUE,
    BUS_COLOURS,
    DASHES,
    GREY,
    MARKERS,
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
)
from ded_bench.truth.network import Network

#: Gaps below this are drawn on a linear scale, larger ones on a logarithmic one, %.
LINEAR_GAP = 0.01
#: Smallest excess over the best that profiles resolve, %.
SMALLEST_EXCESS = 1e-4
#: Terms of a loss that differ by less than this factor are drawn on a linear scale.
LINEAR_SPREAD = 5.0


def tradeoff_figure(points: pd.DataFrame, reference: str) -> Figure:
    """Mean gap to the reference against time per schedule, one panel per regime.

    A method's settings share its colour and marker; a thin line joins them and a word names each but the
    default.

    Args:
        points: see `summary.tradeoff`. Hollow markers: some schedules are infeasible.
        reference: its title.
    """
    points = points.dropna(subset=["gap_percent"])
    regimes = sorted(points["regime"].unique())
    rows = -(-(points["method"].nunique() + 1) // 3)
    with new_figure(7.2, 3.6 + 0.2 * rows) as figure:
        axes = figure.subplots(1, len(regimes), sharey=True, squeeze=False)[0]
        handles = []
        for ax, regime in zip(axes, regimes, strict=True):
            for key, family in points[points["regime"] == regime].groupby("method", sort=False):
                method = str(key)
                style: dict[str, Any] = {"marker": marker(method), "color": colour(method)}
                _draw_family(ax, family.sort_values(["seconds", "gap_percent"]), style)
                label = plain(title(method) + ("" if family["alone"].all() else " *"))
                handles.append(Line2D([], [], linestyle="none", markersize=7, label=label, **style))
            ax.set_xscale("log")
            ax.set_yscale("symlog", linthresh=LINEAR_GAP)
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.axhline(0.0, color=GREY, linewidth=0.8)
            ax.margins(0.14)
            ax.set_title(regime)
            ax.set_xlabel("time per schedule (s), median")
        axes[0].set_ylabel(f"mean gap to {reference} (%)")
        if (points["correct_rate"] < 1).any():
            hollow: dict[str, Any] = {
                "marker": "o",
                "linestyle": "none",
                "markerfacecolor": "white",
                "markersize": 7,
            }
            handles.append(Line2D([], [], color=GREY, label="hollow: some infeasible", **hollow))
        legend_below(figure, handles, columns=3)
    return figure


def _draw_family(ax: Axes, family: pd.DataFrame, style: Mapping[str, Any]) -> None:
    """The points of one method, from fast to slow."""
    if len(family) > 1:
        ax.plot(family["seconds"], family["gap_percent"], color=style["color"], linewidth=0.7, alpha=0.6)
    for row in family.to_dict("records"):
        usual = row["settings"] == "default"
        face = style["color"] if row["correct_rate"] == 1 else "white"
        size: dict[str, Any] = {"markersize": 7 if usual else 5, "markeredgewidth": 1.4 if usual else 1.0}
        place = float(row["seconds"]), float(row["gap_percent"])
        ax.plot(*place, linestyle="none", markerfacecolor=face, **size, **style)
        if not usual:
            ax.annotate(
                plain(f"{row['settings']}{'' if row['alone'] else ' *'}"),
                place,
                xytext=(2, 4),
                textcoords="offset points",
                rotation=35,  # words of neighbours, beside or above each other, do not overlap
                rotation_mode="anchor",
                fontsize=6.5,
                color=style["color"],
            )


def profile_figure(times: pd.DataFrame, objectives: pd.DataFrame) -> Figure:
    """Dolan-Moré profiles of solve time and objective, one column per regime.

    Args:
        times, objectives: see `metrics.performance_profile`.
    """
    regimes = sorted({*times["regime"], *objectives["regime"]})
    drawn = pd.concat([times, objectives])[["method", "settings", "title"]].drop_duplicates()
    variants = {
        str(method): ["default", *sorted({*slugs} - {"default"}, key=natural)]
        for method, slugs in drawn.groupby("method")["settings"]
    }
    titles = drawn["title"].nunique()
    with new_figure(7.2, 4.6 + 0.2 * -(-titles // 3)) as figure:
        axes = figure.subplots(2, max(len(regimes), 1), sharey=True, sharex="row", squeeze=False)
        handles: list[Line2D] = []
        for column, regime in zip(axes.T, regimes, strict=False):
            for ax, profile, is_gap in ((column[0], times, False), (column[1], objectives, True)):
                part = profile[profile["regime"] == regime]
                limit = _last(profile["ratio"], is_gap)
                for key, curve in part.groupby(GROUP[1:], sort=False):
                    method, settings = (str(part) for part in key)
                    variant = variants[method].index(settings)
                    ratio = np.array(curve["ratio"], dtype=float)
                    x = _excess(ratio) if is_gap else ratio
                    x = np.concatenate([x[:1], x, [limit]])
                    y = np.concatenate([[0.0], curve["fraction"], curve["fraction"].iloc[-1:]])
                    handles += ax.step(
                        x,
                        y,
                        where="post",
                        color=colour(method),
                        dashes=dashes(method, variant) or (None, None),
                        linewidth=1.4 if settings == "default" else 0.9,
                        label=plain(str(curve["title"].iloc[0])),
                    )
                ax.set_xscale("log")
                ax.set_ylim(-0.03, 1.03)
                ax.set_xlabel(
                    "objective above the best method's (%)" if is_gap else "solve time over the fastest"
                )
            column[0].set_title(regime)
        for ax in axes[:, 0]:
            ax.set_ylabel("share of instances")
        legend_below(figure, handles, columns=3)
    return figure


def _excess(ratio: Array) -> Array:
    return np.maximum(100.0 * (ratio - 1.0), SMALLEST_EXCESS)


def _last(ratio: pd.Series[float], is_gap: bool) -> float:
    values = np.array(ratio, dtype=float)
    if is_gap:
        return 2.0 * float(_excess(values).max(initial=10 * SMALLEST_EXCESS))
    return 2.0 * float(values.max(initial=2.0))


def history_figure(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Training losses of policies over time on the left, all else that their histories hold on the right.

    Args:
        histories: by name of the policy; columns as `methods.training_record` describes them.
    """
    rows = max(len(histories), 1)
    with new_figure(7.2, 0.6 + 2.3 * rows) as figure:
        axes = figure.subplots(rows, 2, squeeze=False)
        handles: list[Line2D] = []
        for (name, history), (left, right) in zip(histories.items(), axes, strict=False):
            minutes = history["seconds"] / 60
            for column, paint, width in (("training", GREY, 0.8), ("held out", BLACK, 1.4)):
                taken = history.get(column, pd.Series(dtype=float)).dropna()
                if len(taken):
                    left.plot(minutes[taken.index], taken, color=paint, label=column, linewidth=width)
            terms = [c for c in history if c not in ("epoch", "step", "seconds", "training", "held out")]
            for i, term in enumerate(terms):
                dash = DASHES[i % len(DASHES)] or (None, None)
                paint = BUS_COLOURS[i % len(BUS_COLOURS)]
                taken = history[term].dropna()
                handles += right.plot(
                    minutes[taken.index],
                    taken.where(taken > 0),
                    color=paint,
                    dashes=dash,
                    label=plain(str(term)),
                    linewidth=1.1,
                )
            if _spread(history[terms]) > LINEAR_SPREAD:
                right.set_yscale("log")
            right.set_title(plain(name), fontsize=8.5, loc="right")
            left.set_ylabel("loss")
            right.set_ylabel("other columns")
            if left.get_lines():
                legend_above(left, 2)
        for ax in axes[-1]:
            ax.set_xlabel("training time (min)")
        legend_below(figure, handles, columns=5)
    return figure


def _spread(terms: pd.DataFrame) -> float:
    """Largest of all positive values over the smallest; 1 if there is none."""
    values = terms.to_numpy(dtype=float)
    values = values[values > 0]
    return float(values.max() / values.min()) if len(values) else 1.0


def parameters_figure(case: Case, instances: Sequence[Instance]) -> Figure:
    """Distribution of the sampled parameters with the sampler's ranges dotted (paper, Table III)."""
    ranges = case.sampling
    ramps = [ramp for i in instances for ramp in i.ramps(case)]
    initial = np.array([[ramp.initial for ramp in i.ramps(case)] for i in instances])
    relative = (initial / case.load_nominal - 1).ravel()
    rate = np.array([ramp.rate for ramp in ramps])
    least, largest = float(case.load_rate[0].min()), float(case.load_rate[1].max())
    panels: list[tuple[str, Array, tuple[float, ...]]] = [
        ("initial load / nominal − 1", relative, (-ranges.load_relative, ranges.load_relative)),
        ("ramp start (s)", np.array([ramp.start for ramp in ramps]), ranges.start_s),
        ("ramp duration (s)", np.array([ramp.duration for ramp in ramps]), ranges.duration_s),
        ("ramp rate (pu/s)", rate, (-largest, -least, least, largest)),
        ("perturbation $s_i$", perturbations(case, instances), ranges.perturbation),
        (
            "initial $\\omega_i$ (rad/s)",
            np.concatenate([i.omega_initial(case) for i in instances]),
            ranges.omega_rad_per_s,
        ),
        ("cost $c_i$", np.array([c for i in instances for c in i.cost.values()]), ranges.cost),
    ]
    with new_figure(7.2, 3.8) as figure:
        axes = figure.subplots(2, 4).ravel()
        for ax, (label, values, limits) in zip(axes, panels, strict=False):
            ax.hist(values, bins=25, color="#9ecae1", edgecolor="white", linewidth=0.4)
            for limit in limits:
                ax.axvline(limit, color="#444444", linestyle=":", linewidth=1.2)
            ax.set_xlabel(label)
            ax.grid(axis="x", visible=False)
        for ax in (axes[0], axes[4]):
            ax.set_ylabel("count")
        zero = float((rate == 0).mean())
        note = (
            f"{len(instances)} instances\ndotted: ranges of\nthe sampler\n\n"
            f"ramp rate 0:\n{100 * zero:.1f} % of loads\n"
            f"(sampler: {100 * ranges.rate_zero_probability:.0f} %)"
        )
        axes[7].axis("off")
        axes[7].text(0.0, 0.95, note, va="top", transform=axes[7].transAxes)
    return figure


def _nominal(case: Case) -> list[tuple[str, float]]:
    return list(zip(case.loads, case.load_nominal.tolist(), strict=True))


def perturbations(case: Case, instances: Sequence[Instance]) -> Array:
    """s_i recovered from P_0 = P_opt - 0.5 (P_opt - P_nominal) s; left out where P_opt = P_nominal."""
    found = []
    for instance in instances:
        load = instance.p_load(case, np.zeros(1))[0]
        optimum = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), load)
        deviation = optimum - case.p_nominal
        known = np.abs(deviation) > 1e-3
        found.append(2 * (optimum - instance.p_initial(case))[known] / deviation[known])
    return np.concatenate(found)


def forecasts_figure(case: Case, instances: Sequence[Instance], count: int = 25) -> Figure:
    """Load forecasts of the first instances, one of them highlighted, with the nominal load dotted."""
    chosen = list(instances)[:count]
    with new_figure(7.2, 2.6) as figure:
        axes = figure.subplots(1, len(case.loads), sharey=True, squeeze=False)[0]
        handles: list[Line2D] = []
        for ax, (bus, nominal) in zip(axes, _nominal(case), strict=True):
            for instance in chosen[::-1]:
                first = instance is chosen[0]
                handles += ax.plot(
                    *thin(instance.grid, instance.load[bus].at(instance.grid)),
                    color=VERMILION if first else "#9a9a9a",
                    linewidth=1.8 if first else 0.6,
                    label=instance.id if first else f"{len(chosen) - 1} other instances",
                )
            line = bounds(ax, nominal)
            line.set_label("nominal")
            handles.append(line)
            ax.set_title(f"bus {bus}")
            ax.set_xlabel("time (s)")
            ax.set_xlim(0, max(i.horizon_s for i in chosen))
        axes[0].set_ylabel("load injection (pu)")
        legend_below(figure, handles[::-1])
    return figure


def rollout_figure(case: Case, t: Array, errors: Mapping[str, Array]) -> Figure:
    """Error of Koopman rollouts against the swing equations over time, median and worst trajectory.

    Args:
        errors: by the model's kind; Koopman minus swing, shape (n, batch, n_gen + 1), rad/s and pu.
    """
    with new_figure(7.2, 3.0) as figure:
        left, right = figure.subplots(1, 2)
        handles: list[Line2D] = []
        n_gen = len(case.generators)
        for i, (name, error) in enumerate(errors.items()):
            omega = np.abs(error[..., :n_gen]).max(axis=-1) * RAD_TO_HZ
            slack = np.abs(error[..., n_gen])
            for ax, values in ((left, omega), (right, slack)):
                for form, summary, width in (("median", np.median, 1.4), ("worst", np.max, 0.7)):
                    handles += ax.plot(
                        *thin(t, np.maximum(summary(values, axis=1), 1e-12)),
                        color=(BLUE, VERMILION, ORANGE, BLACK)[i % 4],
                        dashes=(None, None) if form == "median" else (2, 1),
                        linewidth=width,
                        label=plain(f"{name}, {form}"),
                    )
        left.set_ylabel("largest error of any $|\\Delta\\omega_i|$ (Hz)")
        right.set_ylabel(f"error of slack $|\\Delta P_{{{case.slack}}}|$ (pu)")
        for ax in (left, right):
            ax.set_yscale("log")
            ax.set_xlabel("time (s)")
            ax.set_xlim(float(t[0]), float(t[-1]))
            lines = [np.asarray(line.get_ydata())[len(thin(t, t)[0]) // 60 :] for line in ax.get_lines()]
            if lines:  # rollouts start exactly: the zeros at t = 0 shall not set the scale
                ax.set_ylim(bottom=0.5 * min(values.min() for values in lines))
        legend_below(figure, handles)
    return figure


def eigenvalue_figure(case: Case, models: Sequence[Koopman]) -> Figure:
    """Eigenvalues of K against the physical modes: in the unit circle, and as rates log(λ)/Δt."""
    network = Network(case)
    physical = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
    with new_figure(7.2, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        angle = np.linspace(0, 2 * np.pi, 400)
        left.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.8)
        handles = right.plot(
            physical.real,
            physical.imag,
            "x",
            color=BLACK,
            markersize=10,
            markeredgewidth=1.6,
            label="physical modes",
        )
        reach = 1.6 * np.abs(physical).max()
        for i, model in enumerate(models):
            values = np.linalg.eigvals(model.k).astype(complex)
            inside = values[np.abs(values) > 1e-9]
            rates = np.log(inside) / model.dt_s
            shown = np.abs(rates) <= reach
            hidden = len(values) - int(shown.sum())
            style: dict[str, Any] = {
                "marker": MARKERS[i % len(MARKERS)],
                "linestyle": "none",
                "markerfacecolor": "none",
                "markeredgecolor": (BLUE, VERMILION, ORANGE)[i % 3],
                "markersize": 6 + 2 * i,
                "markeredgewidth": 1.2,
            }
            left.plot(values.real, values.imag, **style)
            more = f" ({hidden} faster, not shown right)" if hidden else ""
            handles += right.plot(
                rates[shown].real, rates[shown].imag, label=plain(f"K, {model.kind}{more}"), **style
            )
        left.set_aspect("equal")
        left.set_xlabel("Re λ(K)")
        left.set_ylabel("Im λ(K)")
        right.axvline(0.0, color=GREY, linewidth=0.8)
        right.margins(0.15)
        right.set_xlabel("Re log(λ)/Δt (rad/s)")
        right.set_ylabel("Im log(λ)/Δt (rad/s)")
        legend_below(figure, handles, columns=2)
    return figure
