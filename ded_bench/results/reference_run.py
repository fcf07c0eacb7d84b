"""Committed reference runs, one per case: whole in a checkout; an installed package has what answers need.

The package keeps of each `results/<case>-reference/` its models, its policies and the table of objectives
(`run.objectives`), so that every method answers, and every gap has a reference, in an empty folder.
"""

from __future__ import annotations

from pathlib import Path

from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.surrogates import find as surrogates

#: Where reference runs lie: inside an installed package, or in a checkout's results.
REFERENCE_RUNS = next(
    (p for p in (REPOSITORY / "ded_bench" / "_reference_runs", REPOSITORY / "results") if p.is_dir()),
    REPOSITORY / "results",
)


def reference_run(case: Case) -> Path:
    """The results folder of a case's reference run; it need not exist."""
    return REFERENCE_RUNS / f"{case.id}-reference"


def search_folders(case: Case, *first: Path) -> tuple[Path, ...]:
    """Where models and policies are looked for: `first`, the default results, then the reference run."""
    return tuple(dict.fromkeys((*surrogates.search_folders(case, *first), reference_run(case))))
