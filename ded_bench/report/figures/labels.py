"""Words beside points of a figure where they cover least of each other, of points and of curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

from ded_bench.problem.case import Array
from ded_bench.report.figures.style import plain

_Place = tuple[float, float, Literal["left", "center", "right"], Literal["bottom", "center", "top"]]
#: Distances of words from their points, points.
_DISTANCES = (5.0, 11.0, 19.0, 28.0)
#: Where a word may stand: offset in points, and how it is aligned there.
_PLACES: list[_Place] = [
    place
    for d in _DISTANCES
    for place in (
        *((d, 0.6 * d, "left", "bottom"), (d, -0.6 * d, "left", "top")),
        *((-d, 0.6 * d, "right", "bottom"), (-d, -0.6 * d, "right", "top")),
        *((0.0, d, "center", "bottom"), (0.0, -d, "center", "top")),
        *((d, 0.0, "left", "center"), (-d, 0.0, "right", "center")),
    )
]
#: From a word to its point.
_LINE: dict[str, Any] = {"arrowstyle": "-", "linewidth": 0.4, "shrinkA": 0, "shrinkB": 3}
#: Half the size of a marker, points.
_MARKER = 4.0
#: Half the width of a curve, and the distance of places along it, points.
_HALF_LINE, _SPACING = 1.0, 2.0


class Label(NamedTuple):
    """A word, the point it belongs to in data coordinates, and its colour."""

    text: str
    x: float
    y: float
    colour: str


def place_labels(figure: Figure, ax: Axes, labels: Sequence[Label], size: float = 6.5) -> None:
    """Write every word near its point: the nearest place that covers least, joined by a thin line if far."""
    if engine := figure.get_layout_engine():
        engine.execute(figure)  # places are found in pixels, which the layout settles
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    scale = figure.dpi / 72
    taken = []
    for line in ax.get_lines():
        points = line.get_transform().transform(line.get_xydata())
        points = points[np.isfinite(points).all(axis=1)]
        taken += [_around(point, _MARKER * scale) for point in points]
        if line.get_linestyle() != "None":
            taken += [_around(point, _HALF_LINE * scale) for point in _between(points, scale)]
    for label in sorted(labels, key=lambda label: (-label.y, label.x)):
        note = ax.annotate(
            plain(label.text),
            (label.x, label.y),
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=size,
            color=label.colour,
            arrowprops=_LINE | {"color": label.colour},
        )
        note.set_in_layout(False)

        def cost(place: _Place, note: Annotation = note) -> float:
            box = _moved(note, place, canvas)
            covered = sum(_common(box, other) for other in taken)
            outside = box.width * box.height - _common(box, ax.bbox)
            return covered + outside + 0.05 * float(np.hypot(place[0], place[1])) * scale**2

        best = min(_PLACES, key=cost)
        taken.append(_moved(note, best, canvas))
        if note.arrow_patch and float(np.hypot(best[0], best[1])) <= 1.5 * _DISTANCES[0]:
            note.arrow_patch.set_visible(False)


def _moved(note: Annotation, place: _Place, canvas: FigureCanvasAgg) -> Bbox:
    """Put a word at a place; returns what it covers, pixels."""
    note.set_position(place[:2])
    note.set_horizontalalignment(place[2])
    note.set_verticalalignment(place[3])
    note.update_positions(canvas.get_renderer())  # type: ignore[no-untyped-call]
    return super(Annotation, note).get_window_extent(canvas.get_renderer())  # type: ignore[no-untyped-call]


def _between(points: Array, scale: float) -> Array:
    """Points along the straight lines from each pixel position (n, 2) to the next."""
    lengths = np.hypot(*np.diff(points, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.arange(0.0, way[-1], _SPACING * scale)
    return np.stack([np.interp(at, way, column) for column in points.T], axis=1)


def _around(point: Array, half: float) -> Bbox:
    """A square around a pixel position."""
    return Bbox.from_extents(*(point - half), *(point + half))


def _common(a: Bbox, b: Bbox) -> float:
    both = Bbox.intersection(a, b)
    return both.width * both.height if both else 0.0
