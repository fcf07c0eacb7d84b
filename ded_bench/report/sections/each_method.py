"""Each method in detail: gaps, rates, claims, violations, surrogates, worst instances."""

from __future__ import annotations

from ded_bench.analysis.lines import scoring_rows
from ded_bench.analysis.summary import SMALLEST_GAP, by_model, claims, coverage, worst
from ded_bench.methods.options import DEFAULT
from ded_bench.report.columns import CLAIMS, COVERAGE, GAPS, MODELS, RATES, VIOLATIONS, WORST
from ded_bench.report.notes import rows_caption
from ded_bench.report.page import Block, Heading, PageTable, Text, folded, usual_first
from ded_bench.report.sources import Draft, Sources


def tables(sources: Sources) -> dict[str, PageTable]:
    """Every number of every line; others of it stand beside it on the page."""
    overview = sources.summary
    caption = f"Gap to {sources.reference.title}, % ({rows_caption(sources)})"
    several = "What the surrogate contributes: the same method and settings on several"
    more = "Methods that were run on training instances too: all their rows"
    largest = (
        "The three largest gaps and violations of each method, default settings (all: tables/worst.csv); "
        f"gaps up to {SMALLEST_GAP:g} % and violations within tolerance are left out"
    )
    return {
        "summary": PageTable(overview, GAPS, caption),
        "claims": PageTable(claims(sources.judged), CLAIMS, "Rows"),
        "models": PageTable(by_model(overview), MODELS, several),
        "worst": PageTable(worst(sources.judged), WORST, largest),
        "coverage": PageTable(coverage(scoring_rows(sources.rows), sources.judged), COVERAGE, more),
    }


def blocks(draft: Draft) -> list[Block]:
    """Default settings in sight, all others folded away."""
    overview, usual = draft.sources.summary, draft.sources.summary["settings"] == DEFAULT
    made: list[Block] = [
        Heading("Each method in detail"),
        *usual_first(draft.tables["summary"], usual),
        *usual_first(PageTable(overview, RATES, "Claimed and verified: shares of all rows"), usual),
        *folded("Solver status against the scorer's verdict", draft.tables["claims"]),
        *usual_first(PageTable(overview, VIOLATIONS, "Largest violation of each schedule"), usual),
    ]
    for name in ("models", "coverage"):
        made += (
            folded(draft.tables[name].caption, draft.tables[name]) if len(draft.tables[name].frame) else []
        )
    return [*made, *_worst(draft)]


def _worst(draft: Draft) -> list[Block]:
    """Who breaks limits; the instances folded away."""
    frame = draft.tables["worst"].frame
    usual = frame[frame["settings"] == DEFAULT]
    if not len(usual):
        said = "No method exceeds a tolerance, or costs more than the reference."
        return [Heading("Worst instances"), Text(said)]
    broken = usual[usual["worst_by"] == "violation"]
    names = ", ".join(dict.fromkeys(f"{row.title} {row.regime}" for row in broken.itertuples()))
    said = f"Limits are broken, beyond the tolerance, by {names}." if names else "No limit is broken."
    table = PageTable(usual, WORST, draft.tables["worst"].caption)
    return [
        Heading("Worst instances"),
        Text(said),
        *folded("Which instances", table),
        *draft.pictures["worst"],
    ]
