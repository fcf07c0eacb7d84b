"""What a reader of a report must know before comparing its numbers."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from ded_bench.evaluate.summary import REFERENCE
from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import load_manifest, load_split

#: One-minute load average above which a timing was not alone on the machine.
BUSY = 1.5
#: How the tables are to be read.
EXPLANATION = (
    "**Objective and violations are re-simulated**: every schedule is integrated on the true swing "
    "equations, whatever its solver claimed. The increase is the mean of the signed 100·(J / J_DED − 1) over "
    "the `n` instances where both have a score; violations are means of each instance's maximum over time "
    "and generators.",
    "**Failures** are rows without a schedule or a score. They enter no mean, and a method with failures is "
    "never ahead of the paper.",
    "**Against the paper**: ahead if our number is lower than the paper's, behind if it is higher. The "
    "paper's times are from another machine, and its instances are other draws from the same ranges.",
    "**DED's optima are local**: the problem is not convex, so a method may come out below zero; DED also "
    "breaks the tight frequency bound slightly, since backward Euler is not exact.",
    "**Success** is what a method claims, **feasible** what the scorer found: frequency within 1e-4 Hz, "
    "power limits within 1e-6 pu (strictly: 1e-6 Hz and 1e-8 pu).",
    "**The ratio of summed costs** is ΣJ / ΣJ_DED over the same `n` instances: costly instances weigh more "
    "in it than in the mean of the gaps.",
    "**Solution times** are those of `ded-bench bench` alone on one machine; times of the results table were "
    "taken while several workers shared the machine and stand in the details only.",
)


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
            f"No rows yet: `ded-bench solve --case {case.id} --method {REFERENCE[0]} "
            f"--regime {','.join(case.regimes)}` makes some."
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
        notes.append(f"Times of other cases are left out: {len(timings) - len(timing)} rows.")
    stale = sorted(set(timing["problems_version"]) - set(versions)) if versions else []
    if stale:
        notes.append(f"Times were taken on problem version {', '.join(map(named, stale))}.")
    return notes


def named(version: str) -> str:
    """A problem version as a reader sees it."""
    return version or "(none given)"
