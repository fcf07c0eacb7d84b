"""What a reader of a report must know before comparing its numbers, in sentences."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ded_bench.analysis.lines import GROUP, groups, title
from ded_bench.methods.registry import METHODS
from ded_bench.report.sources import Sources

#: One-minute load average above which a timing was not alone on the machine.
BUSY = 1.5


def rows_caption(sources: Sources) -> str:
    """Which rows the tables are about, in words."""
    frame = sources.judged
    if not len(frame):
        return "no rows yet"
    instances = frame["instance"].nunique()
    if (frame["split"] == "test").all():
        left = len(sources.rows) - len(frame)
        return f"{instances} test instances" + (f"; {left} other rows left out" if left else "")
    return f"all {instances} instances, none of them of the test split"


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
    return [
        f"No gap can be given: gaps are to {reference.title}, which has no scored row in this folder, and "
        "the reference run that ships holds no objective for these instances of problem version "
        f"{_versions(judged)}. `{solve}` makes rows to compare with."
    ]


def data_notes(sources: Sources) -> list[str]:
    """What is missing, mixed or old."""
    return [
        *_problems(sources),
        *_reference(sources),
        *_missing(sources),
        *_makers(sources),
        *_times(sources),
    ]


def _versions(rows: pd.DataFrame) -> str:
    return ", ".join(version or "(none given)" for version in sorted(set(rows["problems_version"])))


def _problems(sources: Sources) -> Iterator[str]:
    """Rows of several problem versions, of unknown regimes, or without scores."""
    rows, judged = sources.rows, sources.judged
    versions = set(rows["problems_version"])
    if len(versions) > 1:
        yield f"Rows of different problem versions are not comparable: {_versions(rows)}."
    elif sources.problems_version and versions - {sources.problems_version}:
        yield f"Rows are of problem version {_versions(rows)}, but the files are {sources.problems_version}."
    if strange := sorted(set(judged["regime"]) - set(sources.case.regimes)):
        yield f"Rows of regimes that the case does not know are not drawn: {', '.join(strange)}."
    claimed = judged["status"].isin(("Optimal", "Policy")) & (judged["error"] == "")
    if unscored := int((judged["objective"].isna() & claimed).sum()):
        yield f"{unscored} rows have a schedule but no score yet; they count as failures."


def _reference(sources: Sources) -> Iterator[str]:
    """What gaps rest on, where it is not simply rows of the reference."""
    reference = sources.reference
    if reference.shipped:
        yield (
            f"{reference.shipped} objectives of {reference.title} are those of the reference run that ships "
            "with the case, since it was not run on these instances here."
        )


def _missing(sources: Sources) -> Iterator[str]:
    """Test instances and regimes without rows."""
    tests = list(sources.instances)[: sources.test_count]
    if tests and (sources.judged["split"] == "test").all():
        for regime, key, rows in groups(sources.judged):
            if missing := [name for name in tests if name not in set(rows["instance"])]:
                names = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
                run = f"Only {len(tests) - len(missing)} of {len(tests)} test instances were run"
                yield f"{run}: {title(*key)} {regime} (without {names})."
    for name, lines in sources.summary.groupby("title", sort=False):
        if absent := [regime for regime in sources.case.regimes if regime not in set(lines["regime"])]:
            yield f"No rows of {name} in regime {', '.join(absent)}."


def _makers(sources: Sources) -> Iterator[str]:
    """Rows that today's methods would not make."""
    made = sources.judged[sources.judged["objective"].notna()]
    today = {str(name): METHODS[str(name)].version for name in set(made["method"]) & set(METHODS)}
    old = sorted(
        {m for m, v in zip(made["method"], made["method_version"], strict=True) if v != today.get(m, v)}
    )
    if old:
        names = ", ".join(title(method) for method in old)
        yield f"Rows come from other versions of their methods than those installed here: {names}."


def _times(sources: Sources) -> Iterator[str]:
    """Times that are missing, taken on a busy machine, or of other problems or models than the rows."""
    timing = sources.timing
    if not len(timing):
        yield "Methods were not timed alone on a machine yet; run `ded-bench bench`."
        return
    if (timing["load_average"] > BUSY).any():
        yield "Some methods were timed while the machine was busy (see the column load)."
    if set(timing["problems_version"]) - set(sources.rows["problems_version"]):
        yield f"Times were taken on problem version {_versions(timing)}."
    rows = sources.judged.drop_duplicates(GROUP).set_index(GROUP)["made_with"]
    timed = sources.calls.drop_duplicates(GROUP, keep="last").set_index(GROUP)["made_with"]
    both = timed.index.intersection(rows.index)
    if other := [title(*key[1:]) + f" {key[0]}" for key in both if rows[key] != timed[key]]:
        yield f"Times were taken with another model or policy than the rows: {', '.join(other)}."
