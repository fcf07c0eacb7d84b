"""The figures of a report: one line each in FIGURES."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from ded_bench.report.figures import panels, tradeoff
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

#: The topic under which a section shows a figure, and what draws it, in the order in which they stand.
FIGURES: Mapping[str, Callable[[Sources], Iterator[Picture]]] = {
    "tradeoff": tradeoff.draw,
    "schedules": panels.draw_schedules,
    "online": panels.draw_scenario,
}


def draw_figures(sources: Sources) -> dict[str, list[Picture]]:
    """Draw every figure that there is data for into `<results>/figures`; pictures by topic."""
    return {topic: list(draw(sources)) for topic, draw in FIGURES.items()}
