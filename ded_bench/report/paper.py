"""The lines of the paper's Tables V and VI: its numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ded_bench.analysis.paper_numbers import Paper, PaperRow
from ded_bench.analysis.reference import DEFAULT
from ded_bench.analysis.summary import GROUP, groups, statistics, title


@dataclass(frozen=True, eq=False)
class Line:
    """What a line of Tables V and VI is made from.

    Attributes:
        reference: whether gaps are measured against it.
        statistics: see `summary.statistics`.
        timing: median and quartiles of the times alone on a machine, by column; empty if not timed.
        paper: the paper's numbers, if the method answers to one of its rows.
    """

    regime: str
    method: str
    settings: str
    reference: bool
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
        return math.nan if self.reference else float(self.statistics["gap_percent_mean"])

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


def paper_lines(
    frame: pd.DataFrame, timing: pd.DataFrame, paper: Paper | None, reference: tuple[str, str]
) -> list[Line]:
    """The lines of Tables V and VI: in each regime the paper's rows first, then all others.

    Args:
        frame: rows of the results table with their gaps (see `summary.gaps`).
        timing: one row per (regime, method, settings), of one host.
        paper: its rows are there even if nobody ran the method yet.
        reference: method and settings that gaps are measured against.
    """
    theirs = paper.rows() if paper else {}
    parts = {(regime, method, settings): rows for regime, method, settings, rows in groups(frame)}
    keys = [(regime, method, DEFAULT) for regime, method in theirs]
    keys += [key for key in parts if key not in keys]
    timings = {
        tuple(row[name] for name in GROUP): {str(name): value for name, value in row.items()}
        for row in timing.to_dict("records")
    }
    return [
        Line(
            *key,
            reference=key[1:] == reference,
            statistics=statistics(parts.get(key, frame[:0])),
            timing=timings.get(key, {}),
            paper=theirs.get(key[:2]) if key[2] == DEFAULT else None,
        )
        for key in sorted(keys, key=lambda key: key[0])
    ]
