"""The common look of all figures: colours, markers, dashes, legends, and how a figure is saved.

Colours are Okabe and Ito's, which the colour-blind can distinguish; line styles differ as well, for
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

from ded_bench.analysis.reference import ACCURATE
from ded_bench.analysis.summary import title
from ded_bench.files.strict import write_atomically
from ded_bench.methods.registry import METHODS
from ded_bench.problem.trajectory import Trajectory
from ded_bench.problem.case import Array

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#7f7f7f"
WINE, INDIGO, FOREST, OLIVE = "#882255", "#332288", "#117733", "#999933"
#: Of methods, in the order of their registry.
COLOURS = (BLACK, GREEN, WINE, GREY, BLUE, SKY, ORANGE, VERMILION, PURPLE, INDIGO, FOREST, OLIVE)
BUS_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, BLACK)
DASHES: tuple[tuple[float, ...], ...] = (
    *((), (5, 2), (1.5, 1.5), (6, 2, 1.5, 2), (3, 1.5), (8, 3)),
    *((6, 1.5, 1.5, 1.5, 1.5, 1.5), (10, 2, 3, 2)),
)
#: Methods that may be a case's reference.
SOLID = ("ded", *ACCURATE)
MARKERS = "osD^vP*Xph<>"
#: How many generators or loads a figure shows one by one.
FEW = 6
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


def _place(method: str) -> int:
    """A method's place in the registry; those that are not registered share the next one."""
    known = list(METHODS)
    return known.index(method) if method in known else len(known)


def colour(method: str) -> str:
    """A method's colour, the same in every figure and for all its settings."""
    return COLOURS[_place(method) % len(COLOURS)]


def marker(method: str) -> str:
    """A method's marker in scatter plots, the same for all its settings."""
    return MARKERS[_place(method) % len(MARKERS)]


def dashes(method: str, variant: int = 0) -> tuple[float, ...]:
    """A line style that distinguishes methods in print, and a method's settings; full DED is solid.

    Args:
        variant: which of the method's settings in the figure; 0 are its default.
    """
    if variant == 0 and method in SOLID:
        return ()
    return DASHES[1 + (_place(method) + variant) % (len(DASHES) - 1)]


def busiest(*curves: Array, count: int = FEW) -> list[int]:
    """The columns to show of many: those that move most, in their order; all if there are few.

    Args:
        curves: of shapes (n_points, n), such as one method's each; what counts is the largest range of any.
    """
    ranges = np.max([np.ptp(values, axis=0) for values in curves], axis=0)
    return sorted(np.argsort(-ranges, kind="stable")[:count].tolist())


def envelope(t: Array, values: Array) -> tuple[Array, Array, Array]:
    """Times with the least and the largest of all columns, thinned as curves are (see `thin`)."""
    times, least = thin(t, values.min(axis=1))
    return times, least, thin(t, values.max(axis=1))[1]


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
    """One legend under all panels, each label once, so that it never covers data.

    Args:
        columns: at most so many; fewer where the labels are too long for the figure's width.
    """
    unique = {str(handle.get_label()): handle for handle in handles}
    for count in range(min(columns, max(len(unique), 1)), 0, -1):
        legend = figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=count)
        if count == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def legend_above(ax: Axes, columns: int) -> None:
    """A legend in one line over one panel."""
    ax.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2, columnspacing=1.2
    )


class Shown(NamedTuple):
    """One method's trajectory in a figure."""

    method: str
    settings: str
    trajectory: Trajectory


def draw_line(ax: Axes, shown: Shown, t: Array, values: Array) -> Line2D:
    """A method's curve in its colour and dashes, with its name for the legend."""
    (line,) = ax.plot(
        *thin(t, values),
        color=colour(shown.method),
        dashes=dashes(shown.method) or (None, None),
        label=plain(title(shown.method, shown.settings)),
    )
    return line


def time_axis(axes: Sequence[Axes], columns: int, t: Array) -> None:
    """Limits of the time axis for all panels, its label under the last row of `columns` panels."""
    for ax in axes:
        ax.set_xlim(float(t[0]), float(t[-1]))
    for ax in axes[-columns:]:
        ax.set_xlabel("time (s)")
        ax.tick_params(labelbottom=True)
