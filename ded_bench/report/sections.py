"""Parts of the page with figures and tables of their own, in the order in which they stand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from ded_bench.report.ac_section import ac_blocks, ac_tables, draw_ac
from ded_bench.report.gallery import Gallery
from ded_bench.report.online_section import draw_online, online_blocks, online_tables
from ded_bench.report.page import Block, Table
from ded_bench.run.pool import Call


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        draw: yields the calls that make its figures (see `Gallery.add`), none if there is nothing to draw.
        tables: those that stand in files of their own, too, by the name of the file.
        blocks: its heading, text, tables and pictures (see `Gallery.of`); none if it has nothing to say.
    """

    draw: Callable[[Gallery], Iterator[Call]]
    tables: Callable[[Gallery], Mapping[str, Table]]
    blocks: Callable[[Gallery], list[Block]]


#: All of them.
SECTIONS: tuple[Section, ...] = (
    Section(draw_ac, ac_tables, ac_blocks),
    Section(draw_online, online_tables, online_blocks),
)
