"""What a command tells at its end: a table of the methods that were run, and a line for each that failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TextIO

import pandas as pd

from ded_bench.analysis.online_summary import own_latency
from ded_bench.analysis.reference import choose_reference, read_paper
from ded_bench.analysis.summary import HEAD, gaps, named, newest, outcome, own_first
from ded_bench.cli.arguments import counted, say
from ded_bench.problem.case import Case
from ded_bench.report.columns import ONLINE, OUTCOME
from ded_bench.report.page import PageTable
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.online_results import ONLINE as ONLINE_ROWS
from ded_bench.results.online_results import OnlineRow
from ded_bench.results.rows import ROWS, Results, Row, reference_objectives

#: Of the closed loop's columns, those that a terminal has room for.
_LOOP = (*HEAD, "latency_s", "n", "failures", "increase_percent_mean", "max_excess_mhz_mean", "failed")


def tell_solved(case: Case, results: Results, rows: Sequence[Row], out: TextIO) -> None:
    """Print what became of some rows of a results folder."""
    everything = named(results.frame())
    counting, _ = newest(everything[everything["case"] == case.id])
    reference = choose_reference(counting, read_paper(case.folder), reference_objectives(case))
    found = outcome(gaps(named(ROWS.frame(rows)), reference.objectives))
    print(_text(PageTable(own_first(found), OUTCOME)), file=out)
    better = "`ded-bench bench` takes better ones"
    print(f"gaps are to {reference.title}; times are of this run, {better}", file=out)
    if counting["problems_version"].nunique() > 1:
        print("the folder's rows are of different problem files: gaps may mix them", file=out)
    _tell_failures((row for row in rows if row.objective is None), results.paths)


def tell_operated(rows: Sequence[OnlineRow], paths: ResultsFolder) -> None:
    """Print what became of some rows of the closed loop."""
    frame = named(ONLINE_ROWS.frame(rows)).assign(
        static_objective=float("nan"), static_excess_hz=float("nan")
    )
    columns = tuple(column for column in ONLINE if column.name in _LOOP)
    for forecast, part in frame.groupby("forecast", sort=False):
        print(f"forecast {forecast}:\n{_text(PageTable(own_latency(part), columns))}")
    _tell_failures((row for row in rows if row.error), paths)


def _tell_failures(rows: Iterable[Row | OnlineRow], paths: ResultsFolder) -> None:
    """One line for each method, regime and error."""
    counts = Counter((f"{row.method} {row.regime}", row.error or "without a word") for row in rows)
    for (name, error), count in counts.items():
        say(f"{name}, {counted(count, 'time')}: {error}")
    if counts and paths.failures.is_file():
        say(f"whole tracebacks: {paths.failures}")


def _text(table: PageTable) -> str:
    """A table for a terminal."""
    heads: list[str] = [column.heading for column in table.columns]
    return pd.DataFrame(table.cells, columns=heads).to_string(index=False)
