"""Figures of trajectories: schedules, frequencies, Koopman against swing. Data in, Figure out.

Colours are Okabe and Ito's, which the colour-blind can tell apart; line styles differ as well, for
print in grey. Nothing here touches pyplot's global state.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ded_bench.evaluate.summary import REFERENCE, title
from ded_bench.files.strict import write_atomically
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Array, Case
from ded_bench.truth.simulate import Trajectory

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#7f7f7f"
COLOURS = {
    "ded": BLACK,
    "ded-radau": GREEN,
    "ded-ko": BLUE,
    "ded-ko-knots": SKY,
    "ded-dpc": VERMILION,
    "ded-dpc-paper": ORANGE,
    "ded-dpc-refined": PURPLE,
    "ed": GREY,
}
OTHERS = ("#332288", "#882255", "#117733", "#999933")
BUS_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, BLACK)
DASHES: tuple[tuple[float, ...], ...] = (
    *((), (5, 2), (1.5, 1.5), (6, 2, 1.5, 2), (3, 1.5), (8, 3)),
    *((6, 1.5, 1.5, 1.5, 1.5, 1.5), (10, 2, 3, 2)),
)
MARKERS = "osD^vP*Xph<>"
RAD_TO_HZ = 1 / (2 * np.pi)
DPI = 160
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titley": 1.0,  # else each drawing looks for ticks on top that a title must avoid
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "pdf.fonttype": 42,
    "ps.fonttype": 42,  # matplotlib splits a PDF's fonts by this one: into one part each, not two
    "svg.hashsalt": "ded-bench",
}


class Shown(NamedTuple):
    """One method's trajectory in a figure."""

    method: str
    settings: str
    trajectory: Trajectory


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """A figure of a size in inches, to be filled inside the `with` in the common style."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def save_figure(figure: Figure, stem: Path, formats: Sequence[str] = ("png", "pdf"), dpi: int = DPI) -> None:
    """Write `<stem>.png` and `<stem>.pdf` without a date, so that equal figures are equal files."""
    with mpl.rc_context(STYLE):
        if layout := figure.get_layout_engine():  # once; `savefig` would also draw everything twice
            figure.set_dpi(dpi)
            layout.execute(figure)
            figure.set_layout_engine(None)
        for form in formats:
            buffer = io.BytesIO()
            metadata = {"CreationDate": None} if form == "pdf" else {"Software": None}
            figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata)
            write_atomically(stem.parent / f"{stem.name}.{form}", buffer.getvalue())


def plain(text: str) -> str:
    """A name as matplotlib shall print it: no mathematics in it, and not hidden from legends."""
    return re.sub(r"^_", " _", text.replace("$", r"\$"))


def colour(method: str) -> str:
    """A method's colour, the same in every figure and for all its settings."""
    return COLOURS.get(method, OTHERS[sum(method.encode()) % len(OTHERS)])


def marker(method: str) -> str:
    """A method's marker in scatter plots, the same for all its settings."""
    known = list(METHODS)
    return MARKERS[(known.index(method) if method in known else len(known)) % len(MARKERS)]


def dashes(method: str, variant: int = 0) -> tuple[float, ...]:
    """A line style that tells methods apart in print, and a method's settings; DED is solid.

    Args:
        variant: which of the method's settings in the figure; 0 are its default.
    """
    if (method, variant) == (REFERENCE[0], 0):
        return ()
    known = list(METHODS)
    place = known.index(method) if method in known else len(known)
    return DASHES[1 + (place + variant) % (len(DASHES) - 1)]


def _draw(ax: Axes, shown: Shown, t: Array, values: Array) -> Line2D:
    (line,) = ax.plot(
        *thin(t, values),
        color=colour(shown.method),
        dashes=dashes(shown.method) or (None, None),
        label=plain(title(shown.method, shown.settings)),
    )
    return line


def thin(t: Array, values: Array) -> tuple[Array, Array]:
    """At most about 1500 points of a curve: closer together than any printer or screen resolves."""
    step = max(1, len(t) // 1500)
    return t[::step], values[::step]


def bounds(ax: Axes, *levels: float) -> Line2D:
    """Dotted lines at limits."""
    lines = [
        ax.axhline(level, color="#444444", linestyle=":", linewidth=1.1, label="bound") for level in levels
    ]
    return lines[0]


def legend_below(figure: Figure, handles: Sequence[Line2D], columns: int = 4) -> None:
    """One legend under all panels, each label once, so that it never covers data."""
    unique = {str(handle.get_label()): handle for handle in handles}
    figure.legend(
        unique.values(), unique.keys(), loc="outside lower center", ncols=min(columns, max(len(unique), 1))
    )


def legend_above(ax: Axes, columns: int) -> None:
    """A legend in one line over one panel."""
    ax.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2, columnspacing=1.2
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
            handles += [_draw(axes[j], s, s.trajectory.t, s.trajectory.p_gen[:, j]) for s in shown]
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
            _draw(slack, s, s.trajectory.t, s.trajectory.p_slack)
        slack.set_ylabel(f"slack $P_{{{case.slack}}}$ (pu)")
        for ax in axes[panels:]:
            ax.set_visible(False)
        _time_axis(list(axes[:panels]), 2, shown[0].trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


def frequency_figure(case: Case, regime: str, heading: str, shown: Sequence[Shown]) -> Figure:
    """Frequency deviation at every generator with the regime's bounds (paper, Fig. freq_cmp)."""
    with new_figure(7.2, 0.8 + 1.9 * len(case.generators)) as figure:
        axes = figure.subplots(len(case.generators), 1, sharex=True, squeeze=False).ravel()
        handles = []
        limit = case.regimes[regime].omega_hz
        for j, bus in enumerate(case.generators):
            for s in shown:
                handles.append(_draw(axes[j], s, s.trajectory.t, s.trajectory.omega[:, j] * RAD_TO_HZ))
            handles.append(bounds(axes[j], limit, -limit))
            axes[j].set_ylabel(f"$\\omega_{{{bus}}}$ (Hz)")
        _time_axis(list(axes), 1, shown[0].trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


def koopman_figure(
    case: Case, regime: str, heading: str, trajectory: Trajectory, outputs: Array, name: str
) -> Figure:
    """Koopman rollout against the swing equations under one schedule (paper, Fig. KOswng_cmp).

    Args:
        outputs: the model's (ω, P_s) at the grid points, shape (n, n_gen + 1), rad/s and pu.
        name: the model's kind.
    """
    n_gen = len(case.generators)
    truth = np.column_stack([trajectory.omega * RAD_TO_HZ, trajectory.p_slack])
    model = outputs * np.array([*[RAD_TO_HZ] * n_gen, 1.0])
    labels = [*(f"$\\omega_{{{bus}}}$ (Hz)" for bus in case.generators), f"slack $P_{{{case.slack}}}$ (pu)"]
    limit = case.regimes[regime].omega_hz
    with new_figure(7.2, 0.8 + 1.8 * (n_gen + 1)) as figure:
        axes = figure.subplots(n_gen + 1, 2, sharex=True, width_ratios=(3, 2))
        handles = []
        for j, (left, right) in enumerate(axes):
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
        _time_axis(list(axes.ravel()), 2, trajectory.t)
        legend_below(figure, handles)
        figure.suptitle(heading)
    return figure


class Worst(NamedTuple):
    """One column of `worst_figure`: why it is there, the trajectory, and DED's powers if there are any."""

    reason: str
    shown: Shown
    reference: Array | None  # (n, n_gen), pu


def worst_figure(case: Case, regime: str, heading: str, columns: Sequence[Worst]) -> Figure:
    """The worst instances of one method side by side: powers against DED's, and frequencies."""
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
            for powers in column.reference.T if column.reference is not None else ():
                (line,) = top.plot(*thin(t, powers), color=BLACK, dashes=(4, 2), linewidth=0.9)
                handles["DED"] = line
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


def _time_axis(axes: Sequence[Axes], columns: int, t: Array) -> None:
    for ax in axes:
        ax.set_xlim(float(t[0]), float(t[-1]))
    for ax in axes[-columns:]:
        ax.set_xlabel("time (s)")
        ax.tick_params(labelbottom=True)
