"""Tables and blocks as Markdown and HTML."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench.report.columns import Column
from ded_bench.report.page import Details, PageTable, Picture, write_page
from tests.reading import Page

FRAME = pd.DataFrame(
    {"regime": ["NO", "NO", "TO"], "x": [1.23456e-9, np.nan, 12.0], "n": [1, 2, 3], "s": ["a|b", "&", ""]}
)
COLUMNS = (Column("regime", "Regime"), Column("x", "x_1 (%)"), Column("n", "n"), Column("s", "text"))


def test_a_page_is_written_twice_and_its_tables_too(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"picture")
    table = PageTable(FRAME, COLUMNS, "caption", "numbers")
    folded = Details("more & <more>", ("### Folded", "a <b> c", table))
    blocks = ["# A <title>", "**bold** & `code`", Picture("p.png", "a `picture`"), folded]
    written = write_page(blocks, tmp_path, "page")
    assert [path.name for path in written] == ["p.png", "numbers.csv", "page.md", "page.html"]
    assert pd.read_csv(written[1])["n"].to_list() == [1, 2, 3]
    markdown, text = (path.read_text() for path in written[2:])
    assert "<details><summary>more &amp; &lt;more&gt;</summary>\n\n### Folded\n\na &lt;b> c\n" in markdown
    page = Page(text)
    assert not page.open
    assert "<strong>bold</strong> &amp; <code>code</code>" in text
    assert "A <title>" in page.text
    assert base64.b64encode(b"picture").decode() in text
