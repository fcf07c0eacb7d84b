"""Parts of the page with figures and tables of their own, in the order in which they stand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ded_bench.report.gallery import Gallery
from ded_bench.report.page import Block
from ded_bench.run.pool import Call


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        draw: yields the calls that make its figures (see `Gallery.add`), none if there is nothing to draw.
        blocks: its heading, text, tables and pictures (see `Gallery.of`); none if it has nothing to say.
    """

    draw: Callable[[Gallery], Iterator[Call]]
    blocks: Callable[[Gallery], list[Block]]


#: All of them.
SECTIONS: tuple[Section, ...] = ()
