"""The first screen of a report: what, the two tables, the trade-off, findings and certificates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from ded_bench.analysis.reference import DEFAULT
from ded_bench.analysis.summary import title
from ded_bench.evaluate.ablation import split_slug
from ded_bench.report.columns import FRONT_V, FRONT_VI, Column, tabulate, without_paper
from ded_bench.report.details import rows_caption
from ded_bench.report.findings import findings
from ded_bench.report.gallery import Gallery
from ded_bench.report.notes import EXPLANATION, named
from ded_bench.report.page import (
    Block,
    Heading,
    Items,
    SideBySide,
    Table,
    Text,
    Warnings,
    folded,
)
from ded_bench.report.paper import Line
from ded_bench.report.sources import Sources


def opening_blocks(
    sources: Sources, lines: Sequence[Line], gallery: Gallery, notes: Sequence[str], alarms: Sequence[str]
) -> list[Block]:
    """What a reader must see first.

    Args:
        lines: of Tables V and VI.
        notes: what to know before comparing numbers; folded away.
        alarms: why there is nothing to compare; in sight.
    """
    case, reference = sources.case, sources.reference.title
    front = [line for line in lines if line.paper] or [line for line in lines if _default(line.settings)]
    five, six = result_columns(sources, FRONT_V, FRONT_VI)
    certificates = [
        f"**Certificate** of {title(c.method, c.settings)}: {c.sentence}" for c in sources.certificates
    ]
    regimes = ", ".join(f"{name} |ω| ≤ {limit.omega_hz:g} Hz" for name, limit in case.regimes.items())
    what = (
        f"{len(case.buses)} buses, {len(case.generators)} generators besides the slack bus, "
        f"{len(case.loads)} loads; {rows_caption(sources.judged, sources.rows)}; regimes: {regimes}. "
        f"Every objective and violation is re-simulated; gaps are to {reference}."
    )
    number = f"{len(notes)} note{'s' * (len(notes) != 1)} on what is missing or mixed"
    return [
        Heading(f"Dynamics-aware economic dispatch on {case.id}", 1),
        Text(what),
        Warnings(tuple(alarms)),
        SideBySide(
            (
                Table(tabulate(five, front), five, "Time and increase in objective (Table V)"),
                Table(tabulate(six, front), six, "Mean of the largest violations (Table VI)"),
                Items((*findings(case, lines, reference), *certificates)),
            ),
            tuple(
                gallery.of("tradeoff", "No gap yet: it needs scores of the reference and of another method.")
            ),
        ),
        *(folded(number, Items(tuple(notes))) if notes else []),
    ]


def result_columns(sources: Sources, *tables: tuple[Column, ...]) -> list[tuple[Column, ...]]:
    """The columns of both tables as they fit the case: without the paper's where it has no numbers."""
    if sources.paper:
        return list(tables)
    return [without_paper(columns, sources.reference.title) for columns in tables]


def result_blocks(
    sources: Sources,
    frames: Mapping[str, pd.DataFrame],
    printed: Mapping[str, tuple[Column, ...]],
    captions: Mapping[str, str],
    gallery: Gallery,
) -> list[Block]:
    """What was run; both tables with every method and variant, how to read them, and the paper's figures."""
    everything = sources.rows
    counts = everything["split"].value_counts().to_dict()
    parts = ", ".join(f"{count} on {_split_name(str(name))} instances" for name, count in counts.items())
    names = ", ".join(dict.fromkeys(frames["summary"]["title"])) or "none yet"
    dates = [date for date in everything["date"] if date]
    items = (
        f"Methods: {names}.",
        f"Rows: {len(everything)}" + (f" ({parts})." if parts else "."),
        f"Problem version: {', '.join(map(named, sorted(set(everything['problems_version'])))) or '–'}.",
        f"Rows made: {min(dates)} to {max(dates)}." if dates else "Rows made: –.",
    )
    whole = [Table(frames[name], printed[name], caption) for name, caption in captions.items()]
    figures = gallery.of("paper", "No trajectory can be drawn yet.")
    return [
        Heading("Both tables in full"),
        *folded("All methods and variants, with verdicts", *whole),
        *folded("How to read them", Items(EXPLANATION)),
        *folded("What was run", Items(items)),
        Heading("Schedules and frequencies"),
        *figures,
    ]


def _default(settings: str) -> bool:
    """Whether settings are the default ones, on whatever model."""
    return split_slug(settings)[0] == DEFAULT


def _split_name(split: str) -> str:
    return {"train": "training", "none": "other"}.get(split, split)
