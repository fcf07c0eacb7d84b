"""The report of a results folder: its rows → tables as CSV, figures as PNG, one page as Markdown and HTML."""

from __future__ import annotations

from pathlib import Path

from ded_bench.files.strict import write_atomically
from ded_bench.problem.case import Case
from ded_bench.report.figures import draw_figures
from ded_bench.report.page import render_html, render_markdown
from ded_bench.report.sections import SECTIONS
from ded_bench.report.sources import Draft, read_sources


def write_report(case: Case, folder: Path, problems: Path) -> list[Path]:
    """Write tables, figures and the report of a results folder into it; nothing is solved.

    Whatever is missing (times, policies, a method) is said in the report.

    Args:
        case: whose rows count.
        folder: the results folder.
        problems: folder of the case's instances, split and manifest.

    Returns:
        The files written.

    Raises:
        InputError: the folder holds no results of this case, or a table in it is wrong.
    """
    sources = read_sources(case, folder, problems)
    paths = sources.results.paths
    tables = {name: table for section in SECTIONS for name, table in section.tables(sources).items()}
    for name, table in tables.items():
        write_atomically(paths.tables / f"{name}.csv", table.frame.to_csv(index=False))
    pictures = draw_figures(sources)
    draft = Draft(sources, tables, pictures)
    blocks = [block for section in SECTIONS for block in section.blocks(draft)]
    write_atomically(paths.report("md"), render_markdown(blocks))
    write_atomically(paths.report("html"), render_html(blocks, folder))
    drawn = [folder / picture.path for group in pictures.values() for picture in group]
    written = [paths.tables / f"{name}.csv" for name in tables]
    return [*written, *drawn, paths.report("md"), paths.report("html")]
