"""The comparison of two results folders as text for a terminal, and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable

from ded_bench.analysis.compare import Change, Comparison, name_of

#: Rows that a section of the printed comparison names; the rest are counted.
SHOWN = 10


def to_text(comparison: Comparison) -> str:
    """The comparison for a terminal: a few lines for each kind of change, one verdict."""
    c = comparison
    lines = [f"A  {c.a}: {c.heads[0]}", f"B  {c.b}: {c.heads[1]}"]
    if c.incomparable:
        return "\n".join([*lines, f"not comparable: {c.incomparable}"]) + "\n"
    counts = []
    for name, keys in (("only in A", c.only_a), ("only in B", c.only_b)):
        if keys:
            counts.append(f"{len(keys)} rows {name}")
            lines += _section(f"{name}: {len(keys)} rows", map(name_of, keys))
    for column in dict.fromkeys(change.column for change in c.changes):
        found = [change for change in c.changes if change.column == column]
        counts.append(f"{len(found)} × {column}")
        said = (f"{name_of(change.key)}: {_arrow(change)}" for change in found)
        lines += _section(f"{column}: {len(found)} of {c.common} common rows", said)
    verdict = f"differ: {', '.join(counts)}" if counts else f"agree on {c.common} common rows"
    return "\n".join([*lines, f"A and B {verdict}"]) + "\n"


def to_json(comparison: Comparison) -> str:
    """The comparison as one JSON object; infinite sizes and missing numbers are null."""
    c = comparison
    changes = [
        change.key._asdict()
        | {"column": change.column, "before": change.before, "after": change.after}
        | {"size": change.size if math.isfinite(change.size) else None}
        for change in c.changes
    ]
    made = {name: getattr(c, name) for name in ("a", "b", "same", "incomparable", "common")}
    made |= {name: [key._asdict() for key in getattr(c, name)] for name in ("only_a", "only_b")}
    return json.dumps(made | {"changes": changes}, default=str)


def _section(heading: str, items: Iterable[str]) -> list[str]:
    said = [f"  {item}" for item in items]
    rest = [f"  … and {len(said) - SHOWN} more"] if len(said) > SHOWN else []
    return [heading, *said[:SHOWN], *rest]


def _arrow(change: Change) -> str:
    numbers = isinstance(change.before, float) and isinstance(change.after, float)
    by = f" ({'relative ' if change.column == 'objective' else ''}{change.size:.2g})" if numbers else ""
    return f"{_cell(change.before)} → {_cell(change.after)}{by}"


def _cell(value: object) -> str:
    return "(none)" if value is None else f"{value:.10g}" if isinstance(value, float) else str(value)
