"""What made the numbers: trainings of policies, certificates, versions, machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import pandas as pd

from ded_bench.analysis.lines import HEAD, groups, head, titled
from ded_bench.report.columns import CERTIFICATE, PROVENANCE, TRAINING
from ded_bench.report.page import Block, Heading, Items, PageTable, Picture, Text, folded
from ded_bench.report.sources import Sources, trainings
from ded_bench.run.environment import environment, now


def trained(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """How policies were trained, and their certificates."""
    frame = trainings(sources.results.paths.policies)
    made: list[Block] = [Heading("Training of the policies")]
    if len(frame):
        filled = frame.map(lambda value: value not in ("", None)).any()
        columns = tuple(column for column in TRAINING if filled[column.name])
        made.append(PageTable(frame, columns, "", "training"))
    else:
        made.append(Text("The folder holds no policy; `ded-bench train-dpc` trains one."))
    made += [*pictures["training"], Heading("Certificate")]
    if not sources.certificates:
        return [*made, Text("No certificate was made for these results; `ded-bench certify` makes one.")]
    certificates = titled(pd.DataFrame([{"model": ""} | c.model_dump() for c in sources.certificates]))
    return [*made, PageTable(certificates, CERTIFICATE, "All that makes them up stands in certificate.json")]


def made_by(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Versions of every line folded away; machines and versions in sight."""
    rows = sources.rows
    names = ("version", "commit", "method_version", "made_with", "solver_version")
    lines = [
        head(regime, key) | {"rows": len(group)} | {name: _listed(group[name]) for name in names}
        for regime, key, group in groups(sources.judged)
    ]
    table = PageTable(pd.DataFrame(lines, columns=[*HEAD, "rows", *names]), PROVENANCE, "", "provenance")

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
    whole = folded("Versions, surrogates and policies of every line", table)
    return [Heading("What made the rows"), *whole, Items(items)]


def _listed(values: pd.Series[str]) -> str:
    """Distinct values, the most frequent first; with their numbers, if there are several."""
    counts = Counter(str(value) for value in values)
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{value or 'unknown'} × {count}" for value, count in counts.most_common())
