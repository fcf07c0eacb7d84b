"""The paper's two tables, what they say and what to know first; then both in full, and the schedules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import on_usual_model, title
from ded_bench.analysis.paper_numbers import result_lines
from ded_bench.methods.options import DEFAULT
from ded_bench.plants.score import FEASIBLE_HZ, FEASIBLE_PU, STRICT_HZ, STRICT_PU
from ded_bench.problem.case import Case
from ded_bench.report.columns import TABLE_V, TABLE_VI, tabulate, without_paper
from ded_bench.report.notes import alarms, data_notes, rows_caption
from ded_bench.report.page import Block, Heading, Items, PageTable, Picture, Text, folded, usual_first
from ded_bench.report.sources import Sources

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
    "taken while several workers shared the machine and stand in no table here.",
    "**Names** in brackets are options and surrogates that differ from a method's usual ones.",
)


def opening(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """The first screen, and all methods folded away."""
    case, reference, paper = sources.case, sources.reference, sources.paper
    regimes = ", ".join(f"{name} |ω| ≤ {limit.largest_hz:g} Hz" for name, limit in case.regimes.items())
    what = (
        f"{case.n_bus} buses, {len(case.generators)} generators besides the slack bus, "
        f"{len(case.loads)} loads; {rows_caption(sources)}; regimes: {regimes}. "
        f"Every objective and violation is re-simulated; gaps are to {reference.title}."
    )
    # Beside the paper's numbers, methods stand on their usual surrogates alone.
    rows = on_usual_model(sources.judged) if paper else sources.judged
    lines = result_lines(rows, sources.timing, paper, reference.method)
    five, six = _paper_tables(sources, lines)
    papers = lines["paper_solve_s"].notna()
    shown = papers if papers.any() else lines["settings"] == DEFAULT
    said = [*_fastest(case, lines, reference.title), *_against_paper(five.frame, six.frame)]
    said += [f"**Certificate** of {title(c.method, c.settings)}: {c.sentence}" for c in sources.certificates]
    notes = (*data_notes(sources), *sources.notes)
    return [
        Heading(f"Dynamics-aware economic dispatch on {case.id}", 1),
        Text(what),
        *(Text(text, note=True) for text in alarms(sources)),
        *usual_first(five, shown),
        *usual_first(six, shown),
        Items(tuple(said)),
        *pictures["tradeoff"],
        *folded(f"What is missing or mixed: {len(notes)}", *[Items(notes)] * bool(notes)),
        *folded("How to read the tables", Items(EXPLANATION)),
        Heading("Schedules and frequencies"),
        *pictures["schedules"],
    ]


def _paper_tables(sources: Sources, lines: pd.DataFrame) -> Iterator[PageTable]:
    """Tables V and VI; without the paper's columns where it has no numbers."""
    rows, timing = rows_caption(sources), sources.timing
    timed = "times: not taken yet, run `ded-bench bench`"
    if len(timing):
        counts = "/".join(map(str, sorted(set(timing["instances"]))))
        timed = f"times: median on {counts} instances, alone on {timing['host'].iloc[-1]}"
    for file, columns, caption in (
        ("table_v", TABLE_V, f"Table V: Average Solution Time and Change in Objective ({rows}; {timed})"),
        ("table_vi", TABLE_VI, f"Table VI: Average maximum constraint violation ({rows})"),
    ):
        own = columns if sources.paper else without_paper(columns, sources.reference.title)
        yield PageTable(tabulate(own, lines), own, caption, file)


def _fastest(case: Case, lines: pd.DataFrame, reference: str) -> Iterator[str]:
    """The fastest method that keeps every limit in the tightest regime (lines: see `result_lines`)."""
    tight = min(case.regimes, key=lambda name: case.regimes[name].largest_hz)
    timed = lines[(lines["regime"] == tight) & (lines["rows"] > 0) & lines["solve_s"].notna()]
    good = timed[timed["correct_rate"] == 1].sort_values("solve_s", kind="stable")
    limit = f"{tight} (|ω| ≤ {case.regimes[tight].largest_hz:g} Hz)"
    if len(timed) and not len(good):
        yield f"**Fast and feasible:** no timed method keeps every limit on every instance of {limit}."
    for best in good[:1].to_dict("records"):
        text = (
            f"**Fast and feasible:** in {limit}, {best['title']} is the fastest method whose schedules keep "
            f"every limit on all {best['rows']} instances: {_seconds(best['solve_s'])}"
        )
        if np.isfinite(best["increase_percent"]):
            text += f" and a mean gap of {best['increase_percent']:+.2g} % to {reference}"
        ratio = timed.loc[timed["is_reference"], "solve_s"].max() / best["solve_s"]
        text += f", {float(f'{ratio:.2g}'):,g} times faster than that" if ratio > 1 else ""
        yield text + "."


def _against_paper(five: pd.DataFrame, six: pd.DataFrame) -> Iterator[str]:
    """How many cells of the paper's tables are ahead of its numbers."""
    marks = pd.concat([table.filter(like="against_paper") for table in (five, six)], axis=1)
    counts = marks.stack().value_counts()
    if total := int(counts.drop("", errors="ignore").sum()):
        behind = dict.fromkeys(
            five[(marks == "behind").any(axis=1)][["title", "regime"]].agg(" ".join, axis=1)
        )
        yield (
            f"**Against the paper:** {counts.get('ahead', 0)} of {total} cells of both tables are ahead of "
            f"its numbers, {counts.get('equal', 0)} equal; behind: {', '.join(behind) or 'none'}."
        )


def _seconds(value: float) -> str:
    return f"{1e3 * value:.3g} ms" if value < 1 else f"{value:.3g} s"
