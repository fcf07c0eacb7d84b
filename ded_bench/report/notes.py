"""What a reader of a report must know before comparing its numbers."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import load_manifest, load_split

#: One-minute load average above which a timing was not alone on the machine.
BUSY = 1.5


def data_notes(
    frame: pd.DataFrame,
    everything: pd.DataFrame,
    overview: pd.DataFrame,
    timings: pd.DataFrame,
    timing: pd.DataFrame,
    case: Case,
    problems: Path,
) -> list[str]:
    """What a reader must know before comparing numbers."""
    notes = []
    versions = sorted(set(everything["problems_version"]))
    try:
        manifest = load_manifest(problems)
        n_test = len(load_split(problems).test)
    except InputError as error:
        notes.append(f"The problem files cannot be read: {error}")
        manifest, n_test = None, 0
    if not len(everything):
        notes.append(
            f"No rows yet: `ded-bench solve --case {case.id} --method ded --regime NO,TO` makes some."
        )
    if len(versions) > 1:
        notes.append(
            f"Rows of different problem versions are not comparable: {', '.join(map(named, versions))}."
        )
    elif manifest and versions and versions[0] != manifest.version:
        notes.append(
            f"Rows are of problem version {named(versions[0])}, but the files are {manifest.version}."
        )
    if everything["version"].nunique() > 1:
        notes.append(
            f"Rows of several versions of ded-bench: {', '.join(sorted(set(everything['version'])))}."
        )
    if strange := sorted(set(frame["regime"]) - set(case.regimes)):
        notes.append(f"Rows of regimes that the case does not know are not drawn: {', '.join(strange)}.")
    unscored = frame[
        frame["objective"].isna() & (frame["error"] == "") & frame["status"].isin(("Optimal", "Policy"))
    ]
    if len(unscored):
        notes.append(f"{len(unscored)} rows have a schedule but no score yet; they count as failures.")
    short = overview[overview["rows"] < n_test]
    if n_test and len(short) and (frame["split"] == "test").all():
        for count, rows in short.groupby("rows"):
            names = ", ".join(f"{row.title} {row.regime}" for row in rows.itertuples())
            notes.append(f"Only {count} of {n_test} test instances were run: {names}.")
    if not len(timing):
        notes.append("Methods were not timed alone on a machine yet; run `ded-bench bench`.")
    elif (timing["load_average"] > BUSY).any():
        notes.append("Some methods were timed while the machine was busy (see the column load).")
    if len(timings) > len(timing):
        notes.append(f"Times of other hosts or cases are left out: {len(timings) - len(timing)} rows.")
    stale = sorted(set(timing["problems_version"]) - set(versions)) if versions else []
    if stale:
        notes.append(f"Times were taken on problem version {', '.join(map(named, stale))}.")
    return notes


def named(version: str) -> str:
    """A problem version as a reader sees it."""
    return version or "(none given)"
