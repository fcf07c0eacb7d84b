"""What changed between two results folders: a benchmark's regression test.

Rows are compared that answer the same question: by instance, regime, method, settings and the name of the
surrogate, the newest of each. Status, feasibility, objective and violations decide.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ded_bench.analysis.lines import title
from ded_bench.files.errors import InputError
from ded_bench.results.rows import Results, Row
from ded_bench.results.timing import model_name


class Asked(NamedTuple):
    """What rows of two folders are compared by."""

    case: str
    instance: str
    regime: str
    method: str
    settings: str
    model: str


@dataclass(frozen=True)
class Tolerance:
    """Largest change that is none: of the objective relative, of violations absolute."""

    objective: float = 1e-6
    hz: float = 1e-6
    pu: float = 1e-8


@dataclass(frozen=True)
class Change:
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


def compare(a: Path, b: Path, tolerance: Tolerance | None = None, common_only: bool = False) -> Comparison:
    """Compare two results folders.

    Args:
        a: the folder that sets the standard.
        b: the folder that is compared with it.
        tolerance: changes up to this are none; None: the default ones.
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
    limits = tolerance or Tolerance()
    changes = [change for key in shared for change in _changes(before[key], after[key], limits)]
    changes.sort(key=lambda change: (list(_limits(limits)).index(change.column), -change.size, change.key))
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


def _limits(tolerance: Tolerance) -> dict[str, float]:
    """Columns that decide, in the order in which they are printed, with the size of a change."""
    return {
        "status": 0.0,
        "feasible": 0.0,
        "objective": tolerance.objective,
        "freq_violation_hz": tolerance.hz,
        "ramp_violation": tolerance.pu,
        "bound_violation": tolerance.pu,
        "initial_violation": tolerance.pu,
    }


def _changes(before: Row, after: Row, tolerance: Tolerance) -> Iterator[Change]:
    for column, limit in _limits(tolerance).items():
        x, y = getattr(before, column), getattr(after, column)
        size = _distance(x, y, relative=column == "objective")
        if size > limit:
            yield Change(_asked(before), column, x, y, size)


def _distance(x: object, y: object, relative: bool) -> float:
    if x == y:
        return 0.0
    if not (isinstance(x, float) and isinstance(y, float)):
        return math.inf
    return abs(y - x) / max(abs(x), abs(y)) if relative else abs(y - x)


def name_of(key: Asked) -> str:
    """What a row answers as a reader sees it; the usual settings and surrogate go without saying."""
    unusual = title(key.method, key.settings, key.model).removeprefix(title(key.method))
    return f"{key.instance} {key.regime} {key.method}{unusual}"
