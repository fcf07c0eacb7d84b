"""The sections of a report: one module each, with `tables` and `blocks`, and one line in SECTIONS."""

from __future__ import annotations

from typing import Protocol

from ded_bench.report.page import Block, PageTable
from ded_bench.report.sections import (
    closed_loop,
    each_method,
    made_by,
    opening,
    solve_times,
    trained,
)
from ded_bench.report.sources import Draft, Sources


class Section(Protocol):
    """One part of the page."""

    def tables(self, sources: Sources) -> dict[str, PageTable]:
        """Tables by the name of their CSV file."""

    def blocks(self, draft: Draft) -> list[Block]:
        """Heading, text, tables and pictures; none if there is nothing to say."""


#: All of them, in the order in which they stand.
SECTIONS: tuple[Section, ...] = (
    opening,
    each_method,
    solve_times,
    trained,
    closed_loop,
    made_by,
)
