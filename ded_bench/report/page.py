"""A page as a list of blocks, as Markdown, and that as one self-contained HTML file."""

from __future__ import annotations

import base64
import html
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from markdown_it import MarkdownIt

from ded_bench.files.strict import write_atomically
from ded_bench.report.columns import Column

#: What the text of a page may hold; links and pictures in it would be strangers'.
MARKDOWN = MarkdownIt("commonmark").enable("table").disable(["link", "autolink", "image"])
STYLE = """
body { margin: 0 auto; max-width: 78rem; padding: 0.5rem 1.25rem 4rem; background: #fff; color: #1b1f24;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, Arial, sans-serif; }
h1 { font-size: 1.5rem; margin: 0.25rem 0; }
h2 { font-size: 1.3rem; margin: 2rem 0 0.5rem; padding-top: 0.75rem; border-top: 1px solid #d0d7de; }
p, ul { max-width: 60rem; }
nav ul { display: flex; flex-wrap: wrap; gap: 0 1rem; list-style: none; padding: 0; font-size: 0.85rem; }
a, summary { color: #0b5cad; }
summary { cursor: pointer; padding: 0.35rem 0; }
details { margin: 0.6rem 0; border: 1px solid #d0d7de; border-radius: 4px; padding: 0 0.8rem; }
code { font: 0.9em ui-monospace, Menlo, Consolas, monospace; background: #f2f4f6; overflow-wrap: anywhere; }
blockquote { background: #fff8e5; border-left: 4px solid #bf8700; margin: 1rem 0; padding: 0.05rem 1rem; }
img { display: block; max-width: min(100%, 56rem); height: auto; }
table { display: block; overflow-x: auto; margin: 1rem 0; border-collapse: collapse; font-size: 0.8rem;
  line-height: 1.3; font-variant-numeric: tabular-nums; }
th { text-align: left; vertical-align: bottom; border-bottom: 1px solid; }
th, td { padding: 0.2rem 0.5rem 0.2rem 0; }
td { vertical-align: top; }
td[style] { white-space: nowrap; }
@media (max-width: 40rem) { body { font-size: 15px; padding: 0.75rem 0.9rem 3rem; } }
"""


@dataclass(frozen=True, eq=False)
class PageTable:
    """A frame, the columns to print and a caption; `file` names the CSV file of the whole frame, if any."""

    frame: pd.DataFrame
    columns: tuple[Column, ...]
    caption: str = ""
    file: str = ""

    @property
    def cells(self) -> list[list[str]]:
        """Printed cells, row by row."""
        values = [[c.cell(value) for value in self.frame[c.name].astype(object)] for c in self.columns]
        return [list(row) for row in zip(*values, strict=True)]


@dataclass(frozen=True)
class Picture:
    """A PNG, by its path relative to the page."""

    path: str
    caption: str


@dataclass(frozen=True)
class Details:
    """Blocks that are folded away under a line that says what they are."""

    summary: str
    blocks: tuple[Block, ...]


#: Text is Markdown; `bullets` makes it of several.
Block = str | PageTable | Picture | Details


def bullets(items: Iterable[str]) -> str:
    """A list in Markdown."""
    return "\n".join(f"- {item}" for item in items)


def folded(summary: str, *blocks: Block) -> list[Block]:
    """The blocks under one line; nothing if there are none."""
    return [Details(summary, blocks)] if blocks else []


def usual_first(table: PageTable, usual: pd.Series[bool]) -> list[Block]:
    """A table of its usual lines, or of all if there are none; that of all is folded away."""
    if not usual.any() or usual.all():
        return [table]
    return [PageTable(table.frame[usual], table.columns, table.caption), *folded("All lines", table)]


def write_page(blocks: Sequence[Block], folder: Path, name: str) -> list[Path]:
    """Write a page as Markdown and HTML, and its tables below `tables/`.

    Args:
        blocks: the first one is the page's title.
        folder: where the page lies, and paths of its pictures start.
        name: of the page's files, without suffix.

    Returns:
        The files written, and the pictures.
    """
    written = []
    for block in _each(blocks):
        if isinstance(block, Picture):
            written.append(folder / block.path)
        elif isinstance(block, PageTable) and block.file:
            written.append(folder / "tables" / f"{block.file}.csv")
            write_atomically(written[-1], block.frame.to_csv(index=False))
    for suffix, text in (("md", render_markdown(blocks)), ("html", render_html(blocks, folder))):
        written.append(folder / f"{name}.{suffix}")
        write_atomically(written[-1], text)
    return written


def _each(blocks: Sequence[Block]) -> Iterator[Block]:
    """All blocks, folded ones too."""
    for block in blocks:
        yield from _each(block.blocks) if isinstance(block, Details) else (block,)


def render_markdown(blocks: Sequence[Block], folder: Path | None = None) -> str:
    """The page as Markdown; no text in it is taken for HTML.

    Args:
        blocks: its parts.
        folder: where paths of pictures start, if they are to be in the text; None: it links to them.
    """
    return "\n".join(_markdown(block, folder) for block in blocks)


def _markdown(block: Block, folder: Path | None) -> str:
    match block:
        case Details(summary, inside):
            head = f"<details><summary>{html.escape(summary)}</summary>"
            return f"{head}\n\n{render_markdown(inside, folder)}\n</details>\n"
        case Picture(caption=caption):
            return f"{_image(block, folder)}\n\n*{_plain(caption)}*\n"
        case PageTable(caption=caption):
            return _plain((f"**{caption}**\n\n" if caption else "") + to_markdown(block))
    return f"{_plain(block)}\n"


def _plain(text: str) -> str:
    """Markdown without HTML."""
    return text.replace("<", "&lt;")


def to_markdown(table: PageTable) -> str:
    """A pipe table; numbers are right-aligned."""
    numbers = table.frame.select_dtypes("number")
    marks = ["---:" if column.name in numbers else "---" for column in table.columns]
    lines = [[column.heading for column in table.columns], marks, *table.cells]
    text = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in text)


def _image(picture: Picture, folder: Path | None) -> str:
    """A link to a picture, or the picture itself."""
    said = re.sub(r"[`*\[\]]", "", picture.caption)
    if folder is None:
        return f"![{_plain(said)}]({picture.path})"
    data = base64.b64encode((folder / picture.path).read_bytes()).decode("ascii")
    return f'<img alt="{html.escape(said)}" src="data:image/png;base64,{data}">'


def render_html(blocks: Sequence[Block], folder: Path) -> str:
    """The page as one file that opens from disk: style inline, pictures as data URIs, no script.

    Args:
        blocks: the first one is the page's title.
        folder: where paths of pictures start.
    """
    tokens, titles = MARKDOWN.parse(render_markdown(blocks, folder)), []
    for opening, inside in itertools.pairwise(tokens):
        if opening.type == "heading_open":
            opening.attrSet("id", re.sub(r"[^a-z0-9]+", "-", inside.content.lower()).strip("-"))
            title = html.escape(html.unescape(inside.content))
            titles.append((opening.tag, f'<li><a href="#{opening.attrs["id"]}">{title}</a></li>'))
    links = "".join(link for tag, link in titles if tag == "h2")
    title, nav = re.sub("<[^>]+>", "", titles[0][1]), f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
    content = MARKDOWN.renderer.render(tokens, MARKDOWN.options, {}).replace("</h1>", f"</h1>\n{nav}", 1)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{content}\n</main>\n</body>\n</html>\n"
    )
