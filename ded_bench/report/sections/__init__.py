"""The sections of a report: each a function of what was read and drawn, and a line in SECTIONS."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ded_bench.report.page import Block, Picture
from ded_bench.report.sections.closed_loop import closed_loop
from ded_bench.report.sections.each_method import each_method, solve_times
from ded_bench.report.sections.made_by import made_by, trained
from ded_bench.report.sections.opening import opening
from ded_bench.report.sources import Sources

#: All of them, in the order in which they stand: what each puts on the page, of the sources and of the
#: pictures by topic (see `figures.FIGURES`). Tables that name a file are written there, too.
SECTIONS: tuple[Callable[[Sources, Mapping[str, list[Picture]]], list[Block]], ...] = (
    opening,
    each_method,
    solve_times,
    trained,
    closed_loop,
    made_by,
)
