"""Objectives of a reference run: what a package without its rows measures gaps against."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ded_bench.files.table import Table
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder, reference_run
from ded_bench.results.rows import Row

#: Rows of drawn validation instances serve choices, not comparisons.
_LEFT_OUT = "validation"


@dataclass(frozen=True)
class Objective:
    """The re-simulated objective of one method in its default settings; comparable within one version."""

    case: str
    instance: str
    regime: str
    method: str
    objective: float
    problems_version: str = ""


OBJECTIVES = Table(Objective)


def objectives_of(rows: Iterable[Row]) -> list[Objective]:
    """The scored rows with default settings and nothing trained, by regime, method and instance."""
    found = [
        Objective(row.case, row.instance, row.regime, row.method, row.objective, row.problems_version)
        for row in rows
        if row.objective is not None
        and row.settings == "default"
        and not (row.model or row.policy)
        and row.split != _LEFT_OUT
    ]
    return sorted(found, key=lambda o: (o.regime, o.method, o.instance))


def reference_objectives(case: Case) -> list[Objective]:
    """The objectives of a case's reference run; empty where it has none.

    Raises:
        InputError: the table is wrong.
    """
    return OBJECTIVES.existing(ResultsFolder(reference_run(case)).objectives)
