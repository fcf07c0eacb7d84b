"""Each method in detail: gaps, rates, claims, violations, worst instances, and times alone on a machine."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from ded_bench.analysis.lines import groups, titled
from ded_bench.analysis.summary import SMALLEST_GAP, claims, worst
from ded_bench.methods.options import DEFAULT
from ded_bench.report.columns import CLAIMS, GAPS, RATES, TIMING, VIOLATIONS, WORST
from ded_bench.report.notes import rows_caption
from ded_bench.report.page import Block, Heading, PageTable, Picture, Text, folded, usual_first
from ded_bench.report.sources import Sources


def each_method(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away."""
    overview, usual = sources.summary, sources.summary["settings"] == DEFAULT
    caption = f"Gap to {sources.reference.title}, % ({rows_caption(sources)})"
    shares = PageTable(overview, RATES, "Claimed and verified: shares of all rows")
    claimed = PageTable(claims(sources.judged), CLAIMS, "Rows", "claims")
    return [
        Heading("Each method in detail"),
        *usual_first(PageTable(overview, GAPS, caption, "summary"), usual),
        *usual_first(shares, usual),
        *folded("Solver status against the scorer's verdict", claimed),
        *usual_first(PageTable(overview, VIOLATIONS, "Largest violation of each schedule"), usual),
        *_worst(worst(sources.judged), pictures["worst"]),
    ]


def _worst(frame: pd.DataFrame, drawn: list[Picture]) -> list[Block]:
    """Who breaks limits; the instances folded away."""
    usual = frame["settings"] == DEFAULT
    broken = frame[usual & (frame["worst_by"] == "violation")]
    names = ", ".join(dict.fromkeys(f"{row.title} {row.regime}" for row in broken.itertuples()))
    said = f"Limits are broken, beyond the tolerance, by {names}." if names else "No limit is broken."
    caption = (
        "The three largest gaps and violations of each method, default settings; "
        f"gaps up to {SMALLEST_GAP:g} % and violations within tolerance are left out"
    )
    instances = usual_first(PageTable(frame, WORST, caption, "worst"), usual)
    return [Heading("Worst instances"), Text(said), *folded("Which instances", *instances), *drawn]


def solve_times(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away; performance profiles."""
    made: list[Block] = [Text("No method was timed alone yet; run `ded-bench bench`.")]
    if len(sources.timing):
        timing = titled(pd.concat([rows for *_, rows in groups(sources.timing)]))
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        made = usual_first(PageTable(timing, TIMING, caption), timing["settings"] == DEFAULT)
    return [Heading("Times"), *made, *pictures["profile"]]
