"""The common look of all figures: colours, markers, dashes, legends, and how a figure is saved.

Colours follow the order of the registry of methods. Nothing here touches pyplot's global state.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image  # matplotlib brings it

from ded_bench.files.strict import write_atomically
from ded_bench.methods.registry import METHODS
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

BLACK, GREY = "#000000", "#7f7f7f"
#: Colours that the colour-blind can distinguish (Okabe and Ito's first); the last is for methods of others.
PALETTE = (
    *("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"),
    *("#882255", "#332288", "#661100", "#44AA99", "#999933"),
)
DASHES: tuple[Any, ...] = ((None, None), (5, 2), (1.5, 1.5), (6, 2, 1.5, 2), (3, 1.5), (8, 3))
MARKERS = "osD^vP*Xph<>"
#: Width of a figure, inches, and its resolution.
WIDTH, DPI = 7.2, 130
#: Colours of a picture, shades of anti-aliasing included.
COLOURS = 64
STYLE: dict[Any, Any] = {
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
}


@contextmanager
def new_figure(height: float) -> Iterator[Figure]:
    """A figure of WIDTH and a height in inches, to be filled inside the `with` in the common style."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def placed(figure: Figure, sources: Sources, name: str, caption: str) -> Picture:
    """Save a figure as `<results>/figures/<name>.png`; the caption stands below it."""
    save_figure(figure, sources.results.paths.figures / f"{name}.png")
    return Picture(f"figures/{name}.png", caption)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG with a palette, a third of the size; equal figures are equal files."""
    with mpl.rc_context(STYLE):
        if layout := figure.get_layout_engine():  # once; `savefig` would find it for every drawing
            figure.set_dpi(DPI)
            layout.execute(figure)
            figure.set_layout_engine(None)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    small = io.BytesIO()
    Image.open(buffer).convert("RGB").quantize(COLOURS).save(small, format="png", optimize=True)
    write_atomically(path, small.getvalue())


def plain(text: str) -> str:
    """A name as matplotlib shall print it: no mathematics in it, and not hidden from legends."""
    return re.sub(r"^_", " _", text.replace("$", r"\$"))


def look(method: str, place: int = 0) -> dict[str, Any]:
    """A curve in its method's colour, with the dashes of its place among curves that may cover each other."""
    return {"color": colour(method), "dashes": DASHES[place % len(DASHES)]}


def colour(method: str) -> str:
    """A method's colour, the same in every figure and for all its lines."""
    return (BLACK, *PALETTE)[_place(method)]


def marker(method: str) -> str:
    """A method's marker in scatter plots, the same for all its lines."""
    return MARKERS[_place(method)]


def _place(method: str) -> int:
    known = list(METHODS)
    return known.index(method) % len(PALETTE) if method in known else -1


def legend_below(figure: Figure) -> None:
    """One legend under all panels, each label once, so that it never covers data; the figure grows by it."""
    unique = {
        label: line for ax in figure.axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    if unique:
        figure.set_figheight(figure.get_figheight() + 0.19 * -(-len(unique) // 3))
        figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=3)
