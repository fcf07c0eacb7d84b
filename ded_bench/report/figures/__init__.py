"""The figures of a report: one line each in FIGURES."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from ded_bench.report.figures import panels, tradeoff
from ded_bench.report.figures.style import Drawn, save_figure
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

#: The topic under which a section shows a figure, and what draws it, in the order in which they stand.
FIGURES: Sequence[tuple[str, Callable[[Sources], Iterator[Drawn]]]] = (
    ("tradeoff", tradeoff.draw),
    ("schedules", panels.draw_schedules),
    ("online", panels.draw_scenario),
)


def draw_figures(sources: Sources) -> dict[str, list[Picture]]:
    """Draw every figure that there is data for into `<results>/figures`; pictures by topic."""
    pictures: dict[str, list[Picture]] = {}
    for topic, draw in FIGURES:
        placed = pictures.setdefault(topic, [])
        for drawn in draw(sources):
            save_figure(drawn.figure, sources.results.paths.figures / f"{drawn.file}.png")
            placed.append(Picture(f"figures/{drawn.file}.png", drawn.caption))
    return pictures
