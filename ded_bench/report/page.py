"""A report as a list of blocks, and its two renderings: Markdown, and one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from ded_bench.report.columns import Column
from ded_bench.report.render import to_html, to_markdown


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
    """A PNG, by its path relative to the results folder."""

    path: str
    caption: str


Block = Heading | Text | Items | Warnings | Table | Picture


def render_markdown(blocks: Sequence[Block]) -> str:
    """The report as Markdown; pictures are links to the files, and nothing in it is taken for HTML."""
    return "\n".join(_markdown(block) for block in blocks).replace("<", "&lt;")


def _markdown(block: Block) -> str:
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


def render_html(blocks: Sequence[Block], folder: Path) -> str:
    """The report as one page that opens from disk: style inline, pictures as data URIs, no script."""
    title = next((block.text for block in blocks if isinstance(block, Heading)), "Report")
    links = "".join(
        f'<li><a href="#{block.anchor}">{html.escape(block.text)}</a></li>'
        for block in blocks
        if isinstance(block, Heading) and block.level == 2
    )
    body = []
    for block in blocks:
        body.append(_html(block, folder))
        if isinstance(block, Heading) and block.level == 1:
            body.append(f'<nav aria-label="Contents"><ul>{links}</ul></nav>')
    content = "\n".join(body)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{content}\n</main>\n</body>\n</html>\n"
    )


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


def _inline(text: str) -> str:
    escaped = html.escape(text)
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped)
    return re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", escaped)


def _plain(text: str) -> str:
    return re.sub(r"[`*\[\]]", "", text)


STYLE = """
:root { color-scheme: light; --ink: #1b1f24; --soft: #57606a; --line: #d0d7de; --link: #0b5cad; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 78rem; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0.5rem 0 1rem; }
h2 { font-size: 1.4rem; margin: 3rem 0 0.75rem; padding-top: 1rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.1rem; margin: 2rem 0 0.5rem; }
p, ul { max-width: 46rem; }
a { color: var(--link); }
nav ul { display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem; list-style: none; padding: 0; margin: 0 0 1rem;
  max-width: none; }
code { font: 0.9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; background: #f2f4f6;
  padding: 0.1em 0.3em; border-radius: 3px; overflow-wrap: anywhere; }
figure { margin: 1.5rem 0; }
figcaption { color: var(--soft); font-size: 0.9rem; max-width: 46rem; margin: 0.5rem 0; }
.table figcaption { color: var(--ink); font-weight: 600; }
.scroll { overflow-x: auto; }
img { display: block; max-width: 100%; min-width: min(100%, 34rem); height: auto; }
table { border-collapse: collapse; font-size: 0.875rem; line-height: 1.35; font-variant-numeric: tabular-nums;
  border-top: 2px solid var(--ink); border-bottom: 2px solid var(--ink); }
th { text-align: left; vertical-align: bottom; border-bottom: 1px solid var(--ink); }
th, td { padding: 0.3rem 0.7rem 0.3rem 0; }
th + th, td + td { padding-left: 0.7rem; }
td { vertical-align: top; white-space: nowrap; }
.words { white-space: normal; min-width: 14rem; }
.number { text-align: right; }
tr.first td { border-top: 1px solid var(--line); }
tbody tr:hover { background: #f6f8fa; }
.warnings { background: #fff8e5; border-left: 4px solid #bf8700; padding: 0.25rem 1rem; margin: 1rem 0; }
.warnings p { margin: 0.5rem 0; max-width: none; }
@media (max-width: 40rem) {
  body { font-size: 15px; }
  main { padding: 0.75rem 0.9rem 3rem; }
  h1 { font-size: 1.5rem; }
  h2 { font-size: 1.25rem; margin-top: 2rem; }
  img { max-width: none; width: 40rem; min-width: 100%; }
  table { font-size: 0.8rem; }
  .label { position: sticky; left: 0; background: #fff; white-space: normal; max-width: 8.5rem; }
}
@media print { main { max-width: none; } .scroll { overflow: visible; } figure { break-inside: avoid; } }
"""
