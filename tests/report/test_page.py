"""Tables and blocks as Markdown, LaTeX and HTML."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench.report.columns import Column
from ded_bench.report.page import (
    Details,
    Heading,
    Items,
    Picture,
    SideBySide,
    Table,
    Text,
    Warnings,
    render_html,
    render_markdown,
)
from ded_bench.report.render import to_html, to_latex, to_markdown
from tests.reading import Page

FRAME = pd.DataFrame(
    {"regime": ["NO", "NO", "TO"], "x": [1.23456e-9, np.nan, 12.0], "n": [1, 2, 3], "s": ["a|b", "&", ""]}
)
COLUMNS = (Column("regime", "Regime"), Column("x", "x_1 (%)"), Column("n", "n"), Column("s", "text"))


def test_markdown_table() -> None:
    lines = to_markdown(FRAME, COLUMNS).splitlines()
    assert lines[0] == "| Regime | x_1 (%) | n | text |"
    assert lines[1] == "| --- | ---: | ---: | --- |"
    assert lines[2:] == ["| NO | 1.23e-09 | 1 | a\\|b |", "| NO | – | 2 | & |", "| TO | 12 | 3 |  |"]


def test_latex_table() -> None:
    text = to_latex(FRAME, COLUMNS, "50 % & more_", "tab:x")
    assert "\\begin{tabular}{lrrl}" in text
    assert "Regime & x\\_1 (\\%) & n & text \\\\" in text
    assert "NO & $1.23 \\times 10^{-9}$ & 1 & a|b \\\\" in text
    assert "     & -- & 2 & \\& \\\\" in text
    assert text.count("\\midrule") == 2
    assert "\\caption{50 \\% \\& more\\_}" in text
    assert text.count("{") == text.count("}")


def test_html_table() -> None:
    page = Page(to_html(FRAME, COLUMNS))
    assert not page.open
    assert [a.get("class") for a in page.every("tr")] == [None, None, None, "first"]
    assert [a.get("class") for a in page.every("td")][:4] == [None, "number", "number", None]


def test_both_renderings_of_every_block(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"picture")
    blocks = [
        Heading("A <title>", 1),
        Warnings(("watch `out`",)),
        Heading("Part one"),
        Text("some **bold** & `code`"),
        Items(("first", "second")),
        Table(FRAME, COLUMNS, "caption"),
        SideBySide((Text("on the left"),), (Picture("p.png", "a `picture`"),)),
        Details("more & <more>", (Heading("Folded", 3), Text("a <b> c"))),
    ]
    markdown = render_markdown(blocks)
    for part in (
        "# A &lt;title>",
        "> **Note:** watch `out`",
        "## Part one",
        "- second",
        "**caption**",
        "](p.png)",
        "on the left",
        "<details><summary>more &amp; &lt;more&gt;</summary>\n\n### Folded\n",
        "a &lt;b> c\n\n</details>",
    ):
        assert part in markdown
    text = render_html(blocks, tmp_path)
    page = Page(text)
    assert not page.open
    for part in (
        "<strong>bold</strong> &amp; <code>code</code>",
        "<li>second</li>",
        'href="#part-one"',
        'id="part-one"',
        '<div class="side"><div><p>on the left</p></div><div><div class="pictures"><figure>',
        '<details><summary>more &amp; &lt;more&gt;</summary>\n<h3 id="folded">',
        '</h1>\n<nav aria-label="Contents">',
    ):
        assert part in text
    assert "A <title>" in page.text
    assert base64.b64encode(b"picture").decode() in text


def test_pictures_that_follow_each_other_stand_side_by_side(tmp_path: Path) -> None:
    """Wide ones, and those with something between them, do not."""
    (tmp_path / "p.png").write_bytes(b"picture")
    small, wide = Picture("p.png", "small"), Picture("p.png", "wide", wide=True)
    text = render_html([Heading("T", 1), small, small, wide, small, Text("words"), wide], tmp_path)
    rows = text.split('<div class="pictures">')[1:]
    assert [row.partition("</div>\n<")[0].count("small</figcaption>") for row in rows] == [2, 1]
    assert [row.partition("</figure></div>")[0].count("wide</figcaption>") for row in rows] == [0, 0]
    assert text.count("<figure>") == 5
    assert not Page(text).open


def test_a_table_of_many_columns_is_set_smaller() -> None:
    columns = [Column(f"c{i}", f"c{i}") for i in range(12)]
    frame = pd.DataFrame({column.name: [1] for column in columns})
    assert to_html(frame, columns).startswith('<table class="wide">')
    assert to_html(frame, columns[:11]).startswith("<table>")
