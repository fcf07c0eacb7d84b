"""The figures of a report: one module each, and one line in FIGURES."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from ded_bench.report.figures import history, latency, profile, schedules, tradeoff
from ded_bench.report.figures.style import Drawn, save_figure
from ded_bench.report.page import Picture
from ded_bench.report.sources import Sources

#: By the topic under which sections find them: what draws them, in the order in which they stand.
FIGURES: Mapping[str, Callable[[Sources], Iterator[Drawn]]] = {
    "tradeoff": tradeoff.draw,
    "schedules": schedules.draw,
    "profile": profile.draw,
    "training": history.draw,
    "online": latency.draw,
}


def draw_figures(sources: Sources) -> dict[str, list[Picture]]:
    """Draw every figure that there is data for into `<results>/figures`; pictures by topic."""
    pictures: dict[str, list[Picture]] = {}
    for topic, draw in FIGURES.items():
        pictures[topic] = []
        for drawn in draw(sources):
            save_figure(drawn.figure, sources.results.paths.figures / drawn.name)
            pictures[topic].append(Picture(f"figures/{drawn.name}", drawn.caption))
    return pictures
