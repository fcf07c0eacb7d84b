"""Frames as tables in Markdown, HTML and LaTeX: the same cells in each, rounded from the same frame."""

from __future__ import annotations

import html
from collections.abc import Sequence

import pandas as pd

from ded_bench.report.columns import Column

#: Cells with more characters may be broken into lines.
LONG, WORDS = 32, ' class="words"'
#: Tables of so many columns are set in smaller type.
MANY = 12
#: Columns that stay in sight when a narrow screen is scrolled sideways.
LABELS = ("title", "policy")


def rows_of(frame: pd.DataFrame, columns: Sequence[Column]) -> list[list[str]]:
    """Printed cells, row by row."""
    values = [[column.cell(value) for value in frame[column.name].astype(object)] for column in columns]
    return [list(row) for row in zip(*values, strict=True)]


def _numeric(frame: pd.DataFrame, column: Column) -> bool:
    return pd.api.types.is_numeric_dtype(frame[column.name]) and not pd.api.types.is_bool_dtype(
        frame[column.name]
    )


def to_markdown(frame: pd.DataFrame, columns: Sequence[Column]) -> str:
    """A pipe table; numbers are right-aligned."""
    lines = [[column.heading for column in columns]]
    lines += [["---:" if _numeric(frame, column) else "---" for column in columns]]
    lines += rows_of(frame, columns)
    cells = [
        [cell.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;") for cell in line] for line in lines
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def to_html(frame: pd.DataFrame, columns: Sequence[Column]) -> str:
    """An HTML table; classes: numbers `number`, methods `label`, sentences `words`, a new regime `first`."""
    classes = [_class(frame, column) for column in columns]
    head = "".join(
        f'<th scope="col"{kind}>{html.escape(column.heading)}</th>'
        for column, kind in zip(columns, classes, strict=True)
    )
    body = []
    previous = None
    for row in rows_of(frame, columns):
        kinds = [
            WORDS if len(cell) > LONG and "label" not in kind else kind
            for cell, kind in zip(row, classes, strict=True)
        ]
        cells = "".join(f"<td{kind}>{html.escape(cell)}</td>" for cell, kind in zip(row, kinds, strict=True))
        first = ' class="first"' if previous is not None and row[0] != previous else ""
        previous = row[0]
        body.append(f"<tr{first}>{cells}</tr>")
    rows = "\n".join(body)
    size = ' class="wide"' if len(columns) >= MANY else ""
    return f"<table{size}>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>"


def _class(frame: pd.DataFrame, column: Column) -> str:
    if column.name in LABELS:
        return ' class="label"'
    return ' class="number"' if _numeric(frame, column) else ""


def to_latex(frame: pd.DataFrame, columns: Sequence[Column], caption: str, label: str) -> str:
    """A table with booktabs' rules; the first column is printed once per block, as in the paper."""
    alignment = "".join("r" if _numeric(frame, column) else "l" for column in columns)
    lines = [
        "\\begin{table}",
        "  \\centering",
        f"  \\caption{{{_latex(caption)}}}",
        f"  \\label{{{label}}}",
        f"  \\begin{{tabular}}{{{alignment}}}",
        "    \\toprule",
        f"    {' & '.join(_latex(column.heading) for column in columns)} \\\\",
        "    \\midrule",
    ]
    previous = None
    for row in rows_of(frame, columns):
        if previous is not None and row[0] != previous:
            lines.append("    \\midrule")
        first = "" if row[0] == previous else row[0]
        previous = row[0]
        lines.append(f"    {' & '.join(_latex(cell) for cell in [first, *row[1:]])} \\\\")
    lines += ["    \\bottomrule", "  \\end{tabular}", "\\end{table}", ""]
    return "\n".join(lines)


_LATEX = {
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
    "\\": "\\textbackslash{}",
    "~": "\\textasciitilde{}",
    "^": "\\textasciicircum{}",
    "Δ": "$\\Delta$",
    "ω": "$\\omega$",
    "≤": "$\\leq$",
    "×": "$\\times$",
    "–": "--",
}


def _latex(text: str) -> str:
    """Text or a printed number for LaTeX; 1.1e-09 becomes a power of ten."""
    mantissa, mark, exponent = text.partition("e")
    if mark and mantissa.replace(".", "").lstrip("-").isdigit() and exponent[:1] in ("-", "+"):
        return f"${mantissa} \\times 10^{{{int(exponent)}}}$"
    return "".join(_LATEX.get(mark, mark) for mark in text)
