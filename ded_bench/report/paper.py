"""A paper's numbers beside ours: `paper.json` in a case's folder, and the lines of its Tables V and VI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import Field

from ded_bench.evaluate.summary import GROUP, REFERENCE, gaps, groups, statistics, title
from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record
from ded_bench.problem.case import Case, Name, NonNegative, Number

DEFAULT = "default"


class PaperRow(Record):
    """What a paper reports of one method in one regime; an increase of None is its NA."""

    increase_percent: Number | None
    solve_s: NonNegative
    freq_violation_hz: NonNegative
    ramp_violation: NonNegative


class Paper(Record):
    """The numbers of a paper about one case.

    Attributes:
        case_fingerprint: of the case that the numbers are about.
        methods: by the paper's name of a method, in the order of its tables: ours that answer to it.
        regimes: rows by regime and the paper's name of the method.
    """

    schema_: Literal["ded-bench/paper/1"] = Field(alias="schema")
    source: str
    case_fingerprint: str
    methods: dict[str, tuple[Name, ...]]
    regimes: dict[Name, dict[str, PaperRow]]

    def rows(self) -> dict[tuple[str, str], PaperRow]:
        """The paper's rows by regime and our method, in the paper's order."""
        return {
            (regime, ours): rows[name]
            for regime, rows in self.regimes.items()
            for name, methods in self.methods.items()
            for ours in methods
            if name in rows
        }


def read_paper(problems: Path, case: Case) -> Paper | None:
    """The paper's numbers that lie beside a case's instances; None if there are none.

    Raises:
        InputError: the file is wrong, or names a regime that the case or a method that the file lacks.
    """
    path = problems / "paper.json"
    if not path.is_file():
        return None
    paper = read_record(Paper, path)
    for regime, rows in paper.regimes.items():
        if regime not in case.regimes:
            raise InputError(path, f"regimes.{regime}", f"is no regime of case {case.id}")
        if unknown := sorted(rows.keys() - paper.methods.keys()):
            raise InputError(path, f"regimes.{regime}.{unknown[0]}", "is not among the methods")
    return paper


@dataclass(frozen=True, eq=False)
class Line:
    """What a line of Tables V and VI is made from.

    Attributes:
        rows: results with their gaps (see `summary.gaps`); none if nobody ran the method yet.
        statistics: see `summary.statistics`.
        timing: median and quartiles of the times alone on a machine, by column; empty if not timed.
        paper: the paper's numbers, if the method answers to one of its rows.
    """

    regime: str
    method: str
    settings: str
    rows: pd.DataFrame
    statistics: Mapping[str, Any]
    timing: Mapping[str, Any]
    paper: PaperRow | None

    @property
    def title(self) -> str:
        """The method as tables name it."""
        return title(self.method, self.settings)

    @property
    def increase_percent(self) -> float:
        """Mean signed gap to the reference method; not available for that method itself."""
        if (self.method, self.settings) == REFERENCE:
            return math.nan
        return float(self.statistics["gap_percent_mean"])

    def papers(self, name: str) -> float:
        """A number of the paper; missing if it has none."""
        value = getattr(self.paper, name, None)
        return math.nan if value is None else float(value)

    def verdict(self, ours: float, name: str, failures: int) -> str:
        """How a number of ours stands against the paper's: ahead if it is lower.

        A mean over the instances that did not fail is never ahead. Empty where either number is missing.
        """
        theirs = self.papers(name)
        if math.isnan(ours) or math.isnan(theirs):
            return ""
        if failures or ours > theirs:
            return "behind"
        return "ahead" if ours < theirs else "equal"


def paper_lines(frame: pd.DataFrame, timing: pd.DataFrame, paper: Paper | None) -> list[Line]:
    """The lines of Tables V and VI: in each regime the paper's rows first, then all others.

    Args:
        frame: rows of the results table.
        timing: one row per (regime, method, settings), of one host.
        paper: its rows are there even if nobody ran the method yet.
    """
    theirs = paper.rows() if paper else {}
    parts = {(regime, method, settings): rows for regime, method, settings, rows in groups(gaps(frame))}
    keys = [(regime, method, DEFAULT) for regime, method in theirs]
    keys += [key for key in parts if key not in keys]
    timings = {
        tuple(row[name] for name in GROUP): {str(name): value for name, value in row.items()}
        for row in timing.to_dict("records")
    }
    none = gaps(frame[:0])
    return [
        Line(
            *key,
            rows=parts.get(key, none),
            statistics=statistics(parts.get(key, none)),
            timing=timings.get(key, {}),
            paper=theirs.get(key[:2]) if key[2] == DEFAULT else None,
        )
        for key in sorted(keys, key=lambda key: key[0])
    ]
