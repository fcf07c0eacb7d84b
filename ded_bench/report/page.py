"""A report as a list of blocks, and its two renderings: Markdown, and one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from ded_bench.report.columns import Column
from ded_bench.report.render import to_html, to_markdown
from ded_bench.report.stylesheet import STYLE


@dataclass(frozen=True)
class Heading:
    """A section's title; level 1 is the page's own."""

    text: str
    level: int = 2

    @property
    def anchor(self) -> str:
        """Name of the heading in links."""
        return re.sub(r"[^a-z0-9]+", "-", self.text.lower()).strip("-")


@dataclass(frozen=True)
class Text:
    """A paragraph; `code` and **bold** as in Markdown."""

    text: str


@dataclass(frozen=True)
class Items:
    """A bullet list."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Warnings:
    """What the reader must know before believing a number."""

    items: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Table:
    """A frame, the columns to print and a caption."""

    frame: pd.DataFrame
    columns: tuple[Column, ...]
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A PNG, by its path relative to the results folder; beside the next one unless `wide`."""

    path: str
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class Details:
    """Blocks that are folded away under a line that says what they are."""

    summary: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class SideBySide:
    """Two columns where the screen is wide enough, else one after the other."""

    left: tuple[Block, ...]
    right: tuple[Block, ...]


Block = Heading | Text | Items | Warnings | Table | Picture | Details | SideBySide


def folded(summary: str, *blocks: Block) -> list[Block]:
    """The blocks under one line; nothing if there are none."""
    return [Details(summary, blocks)] if blocks else []


def render_markdown(blocks: Sequence[Block]) -> str:
    """The report as Markdown; pictures are links to the files, and no text in it is taken for HTML."""
    return "\n".join(_markdown(block) for block in blocks)


def _markdown(block: Block) -> str:
    match block:
        case Details(summary, blocks):
            inside = render_markdown(blocks)
            return f"<details><summary>{html.escape(summary)}</summary>\n\n{inside}\n</details>\n"
        case SideBySide(left, right):
            return render_markdown((*left, *right))
    return _plain_markdown(block).replace("<", "&lt;")


def _plain_markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}\n"
        case Text(text):
            return f"{text}\n"
        case Items(items):
            return "".join(f"- {item}\n" for item in items)
        case Warnings(items):
            return "".join(f"> **Note:** {item}\n>\n" for item in items)
        case Table(frame, columns, caption):
            return (f"**{caption}**\n\n" if caption else "") + to_markdown(frame, columns)
        case Picture(path, caption):
            return f"![{_plain(caption)}]({path})\n\n*{caption}*\n"
    raise TypeError(block)


def render_html(blocks: Sequence[Block], folder: Path) -> str:
    """The report as one page that opens from disk: style inline, pictures as data URIs, no script."""
    title = next((block.text for block in blocks if isinstance(block, Heading)), "Report")
    links = "".join(
        f'<li><a href="#{block.anchor}">{html.escape(block.text)}</a></li>'
        for block in blocks
        if isinstance(block, Heading) and block.level == 2
    )
    contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
    content = "\n".join((_all(blocks[:1], folder), contents, _all(blocks[1:], folder)))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{content}\n</main>\n</body>\n</html>\n"
    )


def _all(blocks: Sequence[Block], folder: Path) -> str:
    """Blocks one after another; pictures that follow each other share the width of a screen."""
    parts = []
    for small, group in itertools.groupby(blocks, lambda b: isinstance(b, Picture) and not b.wide):
        inside = "\n".join(_html(block, folder) for block in group)
        parts.append(f'<div class="pictures">{inside}</div>' if small else inside)
    return "\n".join(parts)


def _html(block: Block, folder: Path) -> str:
    match block:
        case Heading(text, level):
            return f'<h{level} id="{block.anchor}">{html.escape(text)}</h{level}>'
        case Text(text):
            return f"<p>{_inline(text)}</p>"
        case Items(items):
            return "<ul>" + "".join(f"<li>{_inline(item)}</li>" for item in items) + "</ul>"
        case Warnings(items):
            inside = "".join(f"<p><strong>Note:</strong> {_inline(item)}</p>" for item in items)
            return f'<div class="warnings">{inside}</div>' if items else ""
        case Table(frame, columns, caption):
            words = f"<figcaption>{_inline(caption)}</figcaption>" if caption else ""
            table = to_html(frame, columns)
            return f'<figure class="table">{words}<div class="scroll">{table}</div></figure>'
        case Picture(path, caption):
            data = base64.b64encode((folder / path).read_bytes()).decode("ascii")
            image = f'<img alt="{html.escape(_plain(caption))}" src="data:image/png;base64,{data}">'
            words = f"<figcaption>{_inline(caption)}</figcaption>"
            return f'<figure><div class="scroll">{image}</div>{words}</figure>'
        case Details(summary, blocks):
            return f"<details><summary>{_inline(summary)}</summary>\n{_all(blocks, folder)}\n</details>"
        case SideBySide(left, right):
            parts = (_all(part, folder) for part in (left, right))
            return f'<div class="side">{"".join(f"<div>{part}</div>" for part in parts)}</div>'


def _inline(text: str) -> str:
    escaped = html.escape(text)
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped)
    return re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", escaped)


def _plain(text: str) -> str:
    return re.sub(r"[`*\[\]]", "", text)
