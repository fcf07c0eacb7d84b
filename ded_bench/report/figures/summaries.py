"""Figures of the problems and of the Koopman models: sampled parameters, forecasts, errors, eigenvalues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.report.figures.style import (
    BLACK,
    BLUE,
    FEW,
    GREY,
    MARKERS,
    ORANGE,
    RAD_TO_HZ,
    VERMILION,
    bounds,
    legend_below,
    new_figure,
    plain,
    thin,
)
from ded_bench.surrogates.koopman import Koopman


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
    """Load forecasts of the first instances, one of them highlighted, with the nominal load dotted.

    Of many loads, the FEW that are largest at the nominal point are shown.
    """
    chosen = list(instances)[:count]
    loads = np.sort(np.argsort(-np.abs(case.load_nominal), kind="stable")[:FEW])
    columns = min(len(loads), 3)
    rows = -(-len(loads) // columns)
    with new_figure(7.2, 0.6 + 2.0 * rows) as figure:
        axes = figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False).ravel()
        handles: list[Line2D] = []
        for ax, j in zip(axes, loads.tolist(), strict=False):
            bus = case.loads[j]
            for instance in chosen[::-1]:
                first = instance is chosen[0]
                handles += ax.plot(
                    *thin(instance.grid, instance.load[bus].at(instance.grid)),
                    color=VERMILION if first else "#9a9a9a",
                    linewidth=1.8 if first else 0.6,
                    label=instance.id if first else f"{len(chosen) - 1} other instances",
                )
            line = bounds(ax, float(case.load_nominal[j]))
            line.set_label("nominal")
            handles.append(line)
            ax.set_title(f"bus {bus}")
            ax.set_xlim(0, max(i.horizon_s for i in chosen))
        for ax in axes[len(loads) :]:
            ax.set_visible(False)
        for ax in axes[max(len(loads) - columns, 0) : len(loads)]:
            ax.set_xlabel("time (s)")
            ax.tick_params(labelbottom=True)
        for ax in axes[::columns]:
            ax.set_ylabel("load injection (pu)")
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
    """Eigenvalues of K as rates log(λ)/Δt against the physical modes."""
    network = Network(case)
    physical = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
    with new_figure(5.6, 3.6) as figure:
        ax = figure.subplots()
        handles = ax.plot(
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
            more = f" ({hidden} faster, not shown)" if hidden else ""
            handles += ax.plot(
                rates[shown].real, rates[shown].imag, label=plain(f"K, {model.kind}{more}"), **style
            )
        ax.axvline(0.0, color=GREY, linewidth=0.8)
        ax.margins(0.15)
        ax.set_xlabel("Re log(λ)/Δt (rad/s)")
        ax.set_ylabel("Im log(λ)/Δt (rad/s)")
        legend_below(figure, handles, columns=2)
    return figure
