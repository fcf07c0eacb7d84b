"""Tables and blocks as Markdown and HTML."""

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
    PageTable,
    Picture,
    Text,
    render_html,
    render_markdown,
    to_markdown,
)
from tests.reading import Page

FRAME = pd.DataFrame(
    {"regime": ["NO", "NO", "TO"], "x": [1.23456e-9, np.nan, 12.0], "n": [1, 2, 3], "s": ["a|b", "&", ""]}
)
COLUMNS = (Column("regime", "Regime"), Column("x", "x_1 (%)"), Column("n", "n"), Column("s", "text"))


def test_markdown_table() -> None:
    lines = to_markdown(PageTable(FRAME, COLUMNS)).splitlines()
    assert lines[0] == "| Regime | x_1 (%) | n | text |"
    assert lines[1] == "| --- | ---: | ---: | --- |"
    assert lines[2:] == ["| NO | 1.23e-09 | 1 | a\\|b |", "| NO | – | 2 | & |", "| TO | 12 | 3 |  |"]


def test_both_renderings_of_every_block(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"picture")
    blocks = [
        Heading("A <title>", 1),
        Text("watch `out`", note=True),
        Heading("Part one"),
        Text("some **bold** & `code`"),
        Items(("first", "second")),
        PageTable(FRAME, COLUMNS, "caption"),
        Picture("p.png", "a `picture`"),
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
        '<details><summary>more &amp; &lt;more&gt;</summary>\n<h3 id="folded">',
        '</h1>\n<nav aria-label="Contents">',
    ):
        assert part in text
    assert "A <title>" in page.text
    assert base64.b64encode(b"picture").decode() in text
