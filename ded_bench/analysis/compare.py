"""Rows beside others: what changed between two results folders, and a sample of rows solved again.

Rows of two folders are compared that answer the same question: by instance, regime, method, settings and the
name of the surrogate, the newest of each. Status, feasibility, objective and violations decide.

Rows are solved again with today's code and the folder's models and policies: are they those of the code that
stands beside them? Objectives and violations are re-simulated. Rows that failed or ended by a time limit
depend on the machine: they are named, not compared.
"""

from __future__ import annotations

import json
import math
import random
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ded_bench.analysis.summary import title
from ded_bench.files.errors import InputError
from ded_bench.methods.registry import registered
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.folder import search_folders
from ded_bench.results.rows import Key, Results, Row, differences
from ded_bench.results.timing import model_name
from ded_bench.run.runner import run
from ded_bench.run.tasks import Task, make_tasks
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import MODELS, TRAINED

#: What rows of two folders are compared by; the model by its name alone.
ASKED = Key._fields[: Key._fields.index("model") + 1]
#: Rows that a section of the printed comparison names; the rest are counted.
SHOWN = 10


def limits(objective: float = 1e-6, hz: float = 1e-6, pu: float = 1e-8) -> dict[str, float]:
    """Largest change that is none, by the columns that decide, in the order in which they are printed."""
    powers = "ramp_violation", "bound_violation", "initial_violation"
    exact = dict.fromkeys(("status", "feasible"), 0.0)
    return exact | {"objective": objective, "freq_violation_hz": hz} | dict.fromkeys(powers, pu)


class Change(NamedTuple):
    """One value of one row, before (in A) and after (in B); None is an empty cell."""

    key: Key
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
    only_a: tuple[Key, ...]
    only_b: tuple[Key, ...]
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


def _read(folder: Path) -> dict[Key, Row]:
    results = Results(folder)
    if not results.path.is_file():
        raise InputError(results.path, "", "is missing: this is no results folder")
    rows = sorted(results.rows.values(), key=lambda row: row.date)
    return {Key(*row.key[:5], model_name(row.model)): row for row in rows}


def _head(rows: Mapping[Key, Row]) -> str:
    versions = ", ".join(sorted({row.version for row in rows.values()})) or "–"
    problems = ", ".join(sorted({row.problems_version or "(none)" for row in rows.values()})) or "–"
    return f"{len(rows)} rows, ded-bench {versions}, problems {problems}"


def _incomparable(before: Mapping[Key, Row], after: Mapping[Key, Row], shared: Sequence[Key]) -> str:
    """Why the two tables are not about the same problems; empty if they are."""
    other = [key for key in shared if before[key].problems_version != after[key].problems_version]
    if other:
        was, now = (rows[other[0]].problems_version or "(no version)" for rows in (before, after))
        return (
            f"{len(other)} common rows are of different problems, such as {name_of(other[0])}: "
            f"{other[0].case} {was} in A, {other[0].case} {now} in B"
        )
    return "no row is in both" if before and after and not shared else ""


def name_of(key: Key) -> str:
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
        _asked(change.key)
        | {"column": change.column, "before": change.before, "after": change.after}
        | {"size": change.size if math.isfinite(change.size) else None}
        for change in c.changes
    ]
    made = {name: getattr(c, name) for name in ("a", "b", "same", "incomparable", "common")}
    made |= {name: [_asked(key) for key in getattr(c, name)] for name in ("only_a", "only_b")}
    return json.dumps(made | {"changes": changes}, default=str)


def _asked(key: Key) -> dict[str, Any]:
    return dict(zip(ASKED, key, strict=False))


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


#: Largest change that is none: of the objective relative, of the frequency violation in Hz.
LIMITS = {"objective": 1e-6, "freq_violation_hz": 1e-6}
#: Seed of the sample, with the name of its line.
SEED = 0
#: What makes a line of the sample.
LINE = ["method", "settings", "model", "regime"]


def reproduce(
    case: Case,
    instances: Mapping[str, Instance],
    results: Results,
    methods: Sequence[str] = (),
    sample: int = 5,
    workers: int = 1,
    tell: Callable[[str], None] = lambda sentence: None,
) -> pd.DataFrame:
    """Solve a sample of rows again and compare; the folder stays as it is.

    Args:
        case: of the rows.
        instances: by id; rows of others are skipped.
        results: whose rows are solved again; models and policies of the same folder come first.
        methods: only rows of these; none: of all.
        sample: rows of each line, drawn with a fixed seed.
        workers: processes.
        tell: called with a sentence for everything that differs or is skipped, and why.

    Returns:
        One row per line (see LINE): how many `rows` were solved again, how many of them `differ`, the largest
        relative difference of objectives, and of frequency violations in Hz.

    Raises:
        InputError: there is no row of these methods.
    """
    lines: dict[tuple[str, ...], list[Row]] = {}
    for row in results.rows.values():
        if row.case == case.id and (not methods or row.method in methods):
            name = row.method, row.settings, model_name(row.model), row.regime
            lines.setdefault(name, []).append(row)
    if not lines:
        raise InputError(results.path, "method", f"has no rows of {', '.join(methods) or case.id}")
    asked: list[tuple[tuple[str, ...], Row, Task]] = []
    for line in sorted(lines):
        said = " ".join(filter(None, line))
        for row in _sample(said, lines[line], instances, sample, tell):
            task = _task(case, row, instances, results.folder)
            if isinstance(task, Task):
                asked.append((line, row, task))
            else:
                tell(f"{said}: {row.instance}: {task}")
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as folder:
        solved = run(case, [task for *_, task in asked], Results(folder), workers)
    cells: list[tuple[object, ...]] = [(*line, 0, 0, 0.0, 0.0) for line in sorted(lines)]
    for (line, row, _), again in zip(asked, solved, strict=True):
        apart = dict.fromkeys(LIMITS, 0.0) | differences(row, again, dict.fromkeys(LIMITS, 0.0))
        problem = _problem(row, again, apart)
        if problem:
            tell(f"{' '.join(filter(None, line))}: {row.instance}: {problem}")
        if again.status != Status.TIME_LIMIT:
            cells.append((*line, 1, bool(problem), *apart.values()))
    made = pd.DataFrame(cells, columns=[*LINE, "rows", "differ", "objective", "Hz"])
    by = made.groupby(LINE, sort=False, as_index=False)
    return by.agg({"rows": "sum", "differ": "sum", "objective": "max", "Hz": "max"})


def _sample(
    line: str, rows: Sequence[Row], instances: Mapping[str, Instance], count: int, tell: Callable[[str], None]
) -> list[Row]:
    """Rows to be solved again; what cannot be is told."""
    unlike = [r for r in rows if r.objective is None or r.status in (Status.TIME_LIMIT, Status.FAILED)]
    if unlike:
        named = ", ".join(row.instance for row in unlike[:5]) + (", …" if len(unlike) > 5 else "")
        tell(f"{line}: {len(unlike)} of {len(rows)} rows failed or ended by a limit ({named})")
    known = sorted((r for r in rows if r not in unlike and r.instance in instances), key=lambda r: r.key[1:7])
    if not known and len(unlike) < len(rows):
        tell(f"{line}: its instances are unknown here")
    return random.Random(f"{SEED} {line}").sample(known, min(count, len(known)))


def _task(case: Case, row: Row, instances: Mapping[str, Instance], folder: Path) -> Task | str:
    """The task that makes a row, or why the folder has not what made it."""
    model = model_name(row.model)
    if "." not in row.method and row.method not in registered():
        return "no method has this name"
    if model not in ("", *MODELS):
        return f"made with a model of its own ({model})"
    search = search_folders(case, folder)
    settings = Settings(row.settings, model, time_limit_s=row.time_limit_s, search=search)
    chosen = [(instances[row.instance], row.split)]
    try:
        (task,) = make_tasks(case, chosen, [row.method], [row.regime], settings)
    except InputError as error:
        return str(error)
    if task.key.policy != row.policy or (model in TRAINED and task.key.model != row.model):
        other = row.policy if task.key.policy != row.policy else row.model
        return f"its {other} is not the one in {folder}"
    return task


def _problem(row: Row, again: Row, apart: Mapping[str, float]) -> str:
    """What to say of a row that was solved again; empty if it is as before."""
    if again.status == Status.TIME_LIMIT:
        return "ended by its limit this time"
    if again.objective is None:
        return f"no score this time ({again.error or again.status})"
    if any(apart[name] > limit for name, limit in LIMITS.items()):
        return "; ".join(f"{name} {getattr(row, name)!r}, now {getattr(again, name)!r}" for name in LIMITS)
    return ""
