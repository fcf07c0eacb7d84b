"""The report of a results folder: its rows → tables as CSV, figures as PNG, one page as Markdown and HTML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ded_bench.analysis.summary import findings
from ded_bench.problem.case import Case
from ded_bench.report.figures import draw_figures
from ded_bench.report.page import write_page
from ded_bench.report.sections.details import closed_loop, each_method, made_by, solve_times, trained
from ded_bench.report.sections.opening import opening
from ded_bench.report.sources import read_sources

#: The sections, in the order in which they stand: what each puts on the page, of the sources and of the
#: pictures by topic (see `figures.FIGURES`).
SECTIONS = (opening, each_method, solve_times, trained, closed_loop, made_by)


def write_report(
    case: Case, folder: Path, problems: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Path]:
    """Write tables, figures and the report of a results folder into it; nothing is solved.

    Whatever is missing (times, policies, a method) is said in the report.

    Args:
        case: whose rows count.
        folder: the results folder.
        problems: folder of the case's instances, split and manifest.
        tell: called with each finding, a sentence.

    Returns:
        The files written.

    Raises:
        InputError: the folder holds no results of this case, or a table in it is wrong.
    """
    sources = read_sources(case, folder, problems)
    for sentence in findings(sources.outcome, sources.reference.title):
        tell(sentence.replace("**", ""))
    pictures = draw_figures(sources)
    return write_page([b for section in SECTIONS for b in section(sources, pictures)], folder, "report")
