"""Where results of a case lie unless told otherwise: the default folder, and the committed reference run.

A checkout has whole reference runs, one per case. An installed package has of each its models, its policies
and the table of objectives (`results.objectives`), so that every method answers in an empty folder.
"""

from __future__ import annotations

from pathlib import Path

from ded_bench.problem.case import REPOSITORY, Case

#: Where reference runs lie: inside an installed package, or in a checkout's results.
REFERENCE_RUNS = next(
    (p for p in (REPOSITORY / "ded_bench" / "_reference_runs", REPOSITORY / "results") if p.is_dir()),
    REPOSITORY / "results",
)


def default_results(case: Case) -> Path:
    """Where results of a case lie unless told otherwise, below the working directory."""
    return Path("results") / case.id


def reference_run(case: Case) -> Path:
    """The results folder of a case's reference run; it need not exist."""
    return REFERENCE_RUNS / f"{case.id}-reference"


def search_folders(case: Case, *first: Path) -> tuple[Path, ...]:
    """Where models and policies are looked for: `first`, the default results, then the reference run."""
    return tuple(dict.fromkeys((*first, default_results(case), reference_run(case))))
