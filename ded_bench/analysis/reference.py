"""What results are compared with: a paper's numbers about the case, and the reference of gaps.

A paper's numbers lie in `paper.json` in the case's folder. Where a case carries them, the reference is the
method that the paper measures against; elsewhere an accurate one, whose claims the scorer confirms; where
nobody ran it, the best feasible schedule. Objectives come from the rows of a results folder; where it lacks
some, from the reference run that ships with the case.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from ded_bench.analysis.summary import GROUP, HEAD, head, records, statistics, summary, title
from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record
from ded_bench.methods.options import DEFAULT
from ded_bench.problem.quantities import Name, NonNegative, Number
from ded_bench.results.rows import OBJECTIVES, Objective


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

    @property
    def references(self) -> tuple[str, ...]:
        """Our methods that answer to the one whose own increase is not available: the paper's reference."""
        rows = self.rows()
        compared = {ours for (_, ours), row in rows.items() if row.increase_percent is not None}
        return tuple(dict.fromkeys(ours for _, ours in rows if ours not in compared))


def read_paper(problems: Path) -> Paper | None:
    """The paper's numbers that lie beside a case's instances; None if there are none.

    Raises:
        InputError: the file is wrong, or lacks the method that increases are measured against.
    """
    path = problems / "paper.json"
    if not path.is_file():
        return None
    paper = read_record(Paper, path)
    for regime, rows in paper.regimes.items():
        if unknown := sorted(rows.keys() - paper.methods.keys()):
            raise InputError(path, f"regimes.{regime}.{unknown[0]}", "is not among the methods")
    if not paper.references:
        raise InputError(path, "regimes", "hold no method whose increase is null: that of the reference")
    return paper


def result_lines(rows: pd.DataFrame, timing: pd.DataFrame, paper: Paper, reference: str) -> pd.DataFrame:
    """The lines of the paper's Tables V and VI: in each regime the paper's rows first, then all others.

    Args:
        rows: of the results table with their gaps (see `summary.gaps`).
        timing: one row per line, of one host (see `timing_summary`).
        paper: its rows are there even if nobody ran the method yet.
        reference: method that gaps are measured against, with its default settings.

    Returns:
        What `summary` has, `is_reference`, the time alone on a machine `solve_s` and its `timing_failures`,
        the mean gap `increase_percent` (missing for the reference), mean violations, the paper's numbers as
        `paper_…`, and how ours stand against them.
    """
    ours = {tuple(line[name] for name in GROUP): line for line in records(summary(rows))}
    usual = {key[:2]: key for key in ours if title(*key[1:]) == title(key[1])}
    beside = {usual.get(place, (*place, DEFAULT, "")): numbers for place, numbers in paper.rows().items()}
    times = {tuple(line[name] for name in GROUP): line for line in records(timing)}
    lines = []
    for key in sorted(dict.fromkeys((*beside, *ours)), key=lambda key: str(key[0])):
        line = ours.get(key) or head(key[0], key[1:]) | statistics(rows[:0])
        timed = times.get(key, {})
        line["is_reference"] = (key[1], key[2]) == (reference, DEFAULT)
        line["solve_s"], line["timing_failures"] = timed.get("time_s", math.nan), timed.get("failures", 0)
        line["increase_percent"] = math.nan if line["is_reference"] else line["gap_percent_mean"]
        for name in PaperRow.model_fields:
            number = getattr(beside.get(key), name, None)
            line[f"paper_{name}"] = math.nan if number is None else float(number)
        lines.append(line)
    own = ("is_reference", "solve_s", "timing_failures", "increase_percent")
    papers = (f"paper_{name}" for name in PaperRow.model_fields)
    made = pd.DataFrame(lines, columns=[*HEAD, *statistics(rows[:0]), *own, *papers])
    for name in ("freq_violation_hz", "ramp_violation"):
        made[name] = made[f"{name}_mean"]
    return made.assign(
        against_paper_increase=_against(made, "increase_percent"),
        against_paper_time=_against(made, "solve_s", "timing_failures"),
        against_paper_frequency=_against(made, "freq_violation_hz"),
        against_paper_ramp=_against(made, "ramp_violation"),
    )


def _against(lines: pd.DataFrame, name: str, failures: str = "failures") -> NDArray[np.str_]:
    """How a number of ours stands against the paper's: ahead if it is lower, empty where either is missing.

    A mean over the instances that did not fail is never ahead.
    """
    ours, papers = lines[name], lines[f"paper_{name}"]
    behind = (lines[failures] > 0) | (ours > papers)
    known = ours.notna() & papers.notna()
    return np.select([~known, behind, ours < papers], ["", "behind", "ahead"], "equal")


#: References of cases without a paper's numbers: the first that has feasible rows, no fewer than others.
ACCURATE = ("ded-radau", "ded-slp")
#: What stands for a method where none of these has objectives: the best feasible row of each instance counts.
BEST = ""


@dataclass(frozen=True, eq=False)
class Reference:
    """What gaps are measured against.

    Attributes:
        method: its name, or BEST; the settings are the default ones.
        objectives: by (instance, regime).
        shipped: how many of them come from the case's reference run, not from rows.
        wanted: the method to run where BEST stands in for one.
    """

    method: str
    objectives: pd.Series[float]
    shipped: int = 0
    wanted: str = ""

    @property
    def title(self) -> str:
        """The reference as tables name it."""
        return title(self.method) if self.method else "the best feasible schedule"


def choose_reference(rows: pd.DataFrame, paper: Paper | None, shipped: Sequence[Objective] = ()) -> Reference:
    """Choose the reference of a case, and collect its objectives.

    A shipped objective is used only for instances whose rows are of the same problem version.

    Args:
        rows: of one case in a results folder (see `Results.frame`).
        paper: the paper's numbers about the case.
        shipped: objectives of the case's reference run.
    """
    candidates = paper.references if paper else ACCURATE
    best = _by_instance(rows[rows["feasible"] == True].sort_values("objective"))  # noqa: E712
    ours = set(zip(rows["instance"], rows["problems_version"], strict=True))
    usable = OBJECTIVES.frame([o for o in shipped if (o.instance, o.problems_version) in ours])
    for method in candidates:
        is_reference = (rows["method"] == method) & (rows["settings"] == DEFAULT)
        own_rows = rows[is_reference].dropna(subset=["objective"])
        if not paper:
            confirmed = own_rows["feasible"] == True  # noqa: E712
            if 2 * confirmed.sum() < len(own_rows):
                continue
            own_rows = own_rows[confirmed]
        own = _by_instance(own_rows)
        objectives = own.combine_first(_by_instance(usable[usable["method"] == method]))
        if len(objectives):
            return Reference(method, objectives, len(objectives) - len(own))
    return Reference(BEST if len(best) else candidates[0], best, 0, candidates[-1])


def _by_instance(rows: pd.DataFrame) -> pd.Series[float]:
    found = rows.set_index(["instance", "regime"])["objective"].astype(float)
    return found[~found.index.duplicated()]
