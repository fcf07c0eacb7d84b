"""What made the rows: versions, surrogates, policies, machines."""

from __future__ import annotations

from ded_bench.analysis.lines import HEAD, groups, head, line_table
from ded_bench.report.columns import PROVENANCE
from ded_bench.report.notes import MADE_BY, listed
from ded_bench.report.page import Block, Heading, Items, PageTable, folded
from ded_bench.report.sources import Draft, Sources
from ded_bench.run.environment import environment, now


def tables(sources: Sources) -> dict[str, PageTable]:
    """One line per line of the other tables; several values with their numbers of rows."""
    rows = [
        head(regime, key) | {"rows": len(group)} | {name: listed(group[name]) for name in MADE_BY}
        for regime, key, group in groups(sources.judged)
    ]
    return {"provenance": PageTable(line_table(rows, [*HEAD, "rows", *MADE_BY]), PROVENANCE)}


def blocks(draft: Draft) -> list[Block]:
    """The table folded away; machines and versions in sight."""

    rows = draft.sources.rows

    def distinct(name: str) -> str:
        return "; ".join(sorted({str(value) for value in rows[name] if value})) or "–"

    masters = sorted({seed.split(" ")[0] for seed in rows["seed"] if seed})
    counts = rows["split"].replace({"train": "training", "none": "other"}).value_counts()
    dates = sorted(date for date in rows["date"] if date) or ["–"]
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    items = (
        f"Rows: {', '.join(f'{count} on {name} instances' for name, count in counts.items()) or 'none'}.",
        f"Rows made: {dates[0]} to {dates[-1]}; problem version: {distinct('problems_version')}.",
        f"Hosts of the rows: {distinct('host')}; parallel workers: {distinct('workers')}, one thread each.",
        f"Versions of ded-bench: {distinct('version')}; solvers: {distinct('solver_version')}.",
        f"Master seeds of the instances: {', '.join(masters) or '–'}.",
        f"This report was written {now()} with: {here}.",
    )
    whole = folded("Versions, surrogates and policies of every line", draft.tables["provenance"])
    return [Heading("What made the rows"), *whole, Items(items)]
