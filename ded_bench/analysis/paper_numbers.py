"""A paper's numbers about a case, from `paper.json` in the case's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record
from ded_bench.problem.case import Name, NonNegative, Number


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
