"""What changed between two results folders: a benchmark's regression test.

Rows are compared that answer the same question: by instance, regime, method, settings and the name of the
surrogate, the newest of each. Status, feasibility, objective and violations decide.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ded_bench.analysis.lines import title
from ded_bench.files.errors import InputError
from ded_bench.results.rows import Results, Row, differences
from ded_bench.results.timing import model_name

#: Rows that a section of the printed comparison names; the rest are counted.
SHOWN = 10


class Asked(NamedTuple):
    """What rows of two folders are compared by."""

    case: str
    instance: str
    regime: str
    method: str
    settings: str
    model: str


def limits(objective: float = 1e-6, hz: float = 1e-6, pu: float = 1e-8) -> dict[str, float]:
    """Largest change that is none, by the columns that decide, in the order in which they are printed."""
    powers = "ramp_violation", "bound_violation", "initial_violation"
    exact = dict.fromkeys(("status", "feasible"), 0.0)
    return exact | {"objective": objective, "freq_violation_hz": hz} | dict.fromkeys(powers, pu)


class Change(NamedTuple):
    """One value of one row, before (in A) and after (in B); None is an empty cell."""

    key: Asked
    column: str
    before: str | float | bool | None
    after: str | float | bool | None
    size: float  # relative or absolute; infinite where there is no distance


@dataclass(frozen=True)
class Comparison:
    """What differs between two results folders."""

    a: Path
    b: Path
    heads: tuple[str, str]
    common: int
    incomparable: str  # why nothing was compared; else empty
    only_a: tuple[Asked, ...]
    only_b: tuple[Asked, ...]
    changes: tuple[Change, ...]

    @property
    def same(self) -> bool:
        """Whether nothing changed beyond the tolerances."""
        return not (self.incomparable or self.only_a or self.only_b or self.changes)


def compare(
    a: Path, b: Path, largest: Mapping[str, float] | None = None, common_only: bool = False
) -> Comparison:
    """Compare two results folders.

    Args:
        a: the folder that sets the standard.
        b: the folder that is compared with it.
        largest: changes up to these are none, see `limits`; None: the default ones.
        common_only: rows that only one folder has count as no difference.

    Raises:
        InputError: a folder has no results table, or one that is wrong.
    """
    before, after = _read(a), _read(b)
    shared = [key for key in before if key in after]
    facts = (a, b, (_head(before), _head(after)), len(shared))
    if reason := _incomparable(before, after, shared):
        return Comparison(*facts, reason, (), (), ())
    only_a = () if common_only else tuple(key for key in before if key not in after)
    only_b = () if common_only else tuple(key for key in after if key not in before)
    changes = [
        Change(key, column, getattr(before[key], column), getattr(after[key], column), size)
        for key in shared
        for column, size in differences(before[key], after[key], largest or limits()).items()
    ]
    order = list(limits())
    changes.sort(key=lambda change: (order.index(change.column), -change.size, change.key))
    return Comparison(*facts, "", only_a, only_b, tuple(changes))


def _read(folder: Path) -> dict[Asked, Row]:
    results = Results(folder)
    if not results.path.is_file():
        raise InputError(results.path, "", "is missing: this is no results folder")
    rows = sorted(results.rows.values(), key=lambda row: row.date)
    return {_asked(row): row for row in rows}


def _asked(row: Row) -> Asked:
    return Asked(row.case, row.instance, row.regime, row.method, row.settings, model_name(row.model))


def _head(rows: Mapping[Asked, Row]) -> str:
    versions = ", ".join(sorted({row.version for row in rows.values()})) or "–"
    problems = ", ".join(sorted({row.problems_version or "(none)" for row in rows.values()})) or "–"
    return f"{len(rows)} rows, ded-bench {versions}, problems {problems}"


def _incomparable(before: Mapping[Asked, Row], after: Mapping[Asked, Row], shared: Sequence[Asked]) -> str:
    """Why the two tables are not about the same problems; empty if they are."""
    pairs = [(before[key], after[key]) for key in shared]
    other = [(x, y) for x, y in pairs if (x.case, x.problems_version) != (y.case, y.problems_version)]
    if other:
        x, y = other[0]
        return (
            f"{len(other)} common rows are of different problems, "
            f"such as {name_of(_asked(x))}: {_problems(x)} in A, {_problems(y)} in B"
        )
    if not shared and before and after:
        return "no row is in both"
    return ""


def _problems(row: Row) -> str:
    return f"{row.case} {row.problems_version or '(no version)'}"


def name_of(key: Asked) -> str:
    """What a row answers as a reader sees it; the usual settings and surrogate go without saying."""
    unusual = title(key.method, key.settings, key.model).removeprefix(title(key.method))
    return f"{key.instance} {key.regime} {key.method}{unusual}"


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
