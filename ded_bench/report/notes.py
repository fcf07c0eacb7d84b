"""What a reader of a report must know before comparing its numbers."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ded_bench.analysis.summary import groups, title
from ded_bench.plants.score import FEASIBLE_HZ, FEASIBLE_PU, STRICT_HZ, STRICT_PU
from ded_bench.report.sources import Sources

#: One-minute load average above which a timing was not alone on the machine.
BUSY = 1.5
#: How the tables are to be read.
EXPLANATION = (
    "**Objective and violations are re-simulated**: every schedule is integrated on the true swing "
    "equations, whatever its solver claimed. The increase is the mean of the signed 100·(J / J_ref − 1) over "
    "the `n` instances where both have a score; violations are means of each instance's maximum over time "
    "and generators.",
    "**Failures** are rows without a schedule or a score. They enter no mean, and a method with failures is "
    "never ahead of the paper.",
    "**Against the paper**: ahead if our number is lower than the paper's, behind if it is higher. The "
    "paper's times are from another machine, and its instances are other draws from the same ranges.",
    "**DED's optima are local**: the problem is not convex, so a method may come out below zero; DED also "
    "breaks the tight frequency bound slightly, since backward Euler is not exact.",
    "**Success** is what a method claims, **feasible** what the scorer found: frequency within "
    f"{FEASIBLE_HZ:g} Hz, power limits within {FEASIBLE_PU:g} pu (strictly: {STRICT_HZ:g} Hz and "
    f"{STRICT_PU:g} pu).",
    "**The ratio of summed costs** is ΣJ / ΣJ_ref over the same `n` instances: costly instances weigh more "
    "in it than in the mean of the gaps.",
    "**Solution times** are those of `ded-bench bench` alone on one machine; times of the results table were "
    "taken while several workers shared the machine and stand in the details only.",
)


def data_notes(sources: Sources, overview: pd.DataFrame) -> list[str]:
    """What a reader must know before comparing numbers.

    Args:
        overview: the summary of the rows that the tables are about.
    """
    case, everything, frame, timing = sources.case, sources.rows, sources.judged, sources.timing
    notes = []
    versions = sorted(set(everything["problems_version"]))
    if len(versions) > 1:
        notes.append(
            f"Rows of different problem versions are not comparable: {', '.join(map(named, versions))}."
        )
    elif sources.problems_version and versions and versions[0] != sources.problems_version:
        notes.append(
            f"Rows are of problem version {named(versions[0])}, but the files are {sources.problems_version}."
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
    notes += _reference(sources)
    notes += _missing(sources, overview)
    if not len(timing):
        notes.append("Methods were not timed alone on a machine yet; run `ded-bench bench`.")
    elif (timing["load_average"] > BUSY).any():
        notes.append("Some methods were timed while the machine was busy (see the column load).")
    if sources.other_times:
        notes.append(f"Times of other cases are left out: {sources.other_times} methods.")
    stale = sorted(set(timing["problems_version"]) - set(versions)) if versions else []
    if stale:
        notes.append(f"Times were taken on problem version {', '.join(map(named, stale))}.")
    return notes


def alarms(sources: Sources) -> list[str]:
    """Why a report has nothing to compare; empty if it has."""
    case, judged, reference = sources.case, sources.judged, sources.reference
    solve = f"ded-bench solve --case {case.id} --method {reference.method} --regime {','.join(case.regimes)}"
    if not len(sources.rows):
        return [f"No rows yet: `{solve}` makes some."]
    if not judged["objective"].notna().any():
        return ["No row has a score: every method failed, or nothing was scored yet (see the column error)."]
    if judged["gap_percent"].notna().any():
        return []
    version = ", ".join(map(named, sorted(set(judged["problems_version"]))))
    return [
        f"No gap can be given: gaps are to {reference.title}, which has no scored row in this folder, and "
        "the reference run that ships holds no objective for these instances of problem version "
        f"{version}. `{solve}` makes rows to compare with."
    ]


def _reference(sources: Sources) -> Iterator[str]:
    """What gaps rest on, where it is not simply rows of the reference."""
    reference, judged = sources.reference, sources.judged
    if reference.shipped:
        yield (
            f"{reference.shipped} objectives of {reference.title} are those of the reference run that ships "
            "with the case, since it was not run on these instances here."
        )
    scored = judged[judged["objective"].notna()]
    known = scored.loc[scored["gap_percent"].notna(), ["instance", "regime"]].drop_duplicates()
    wanted = scored[["instance", "regime"]].drop_duplicates()
    if len(known) and len(known) < len(wanted):
        yield (
            f"{reference.title}, which gaps are to, has a score on {len(known)} of {len(wanted)} pairs of "
            "instance and regime: gaps are means over these only (column n)."
        )


def named(version: str) -> str:
    """A problem version as a reader sees it."""
    return version or "(none given)"


def _missing(sources: Sources, overview: pd.DataFrame) -> Iterator[str]:
    """Which rows are missing: test instances, and regimes."""
    frame = sources.judged
    tests = list(sources.instances)[: sources.test_count]
    if tests and (frame["split"] == "test").all():
        for regime, method, settings, rows in groups(frame):
            missing = [name for name in tests if name not in set(rows["instance"])]
            if missing:
                named_ones = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
                yield (
                    f"Only {len(tests) - len(missing)} of {len(tests)} test instances were run: "
                    f"{title(method, settings)} {regime} (without {named_ones})."
                )
    for name, rows in overview.groupby("title", sort=False):
        absent = [regime for regime in sources.case.regimes if regime not in set(rows["regime"])]
        if absent:
            yield f"No rows of {name} in regime {', '.join(absent)}."
