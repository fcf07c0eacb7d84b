"""Rows solved again: a sample of a results folder with today's code and the folder's models and policies.

It answers whether the rows are those of the code that stands beside them. Objectives and violations are
re-simulated. Rows that failed or ended by a time limit depend on the machine: they are named, not compared.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from ded_bench.files.errors import InputError
from ded_bench.methods.registry import registered
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.folder import search_folders
from ded_bench.results.rows import Results, Row, differences
from ded_bench.results.timing import model_name
from ded_bench.run.runner import run
from ded_bench.run.tasks import Task, make_tasks
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import MODELS, TRAINED

#: Largest change that is none: of the objective relative, of the frequency violation in Hz.
LIMITS = {"objective": 1e-6, "freq_violation_hz": 1e-6}
#: Seed of the sample, with the name of its line.
SEED = 0


@dataclass
class Sampled:
    """What came of the sample of one method, settings, surrogate and regime.

    Attributes:
        tell: called with everything that differs or is skipped.
        rows: how many were solved again.
        skipped: what was not, and why: a sentence each.
        differences: a sentence for each row that differs.
        objective: largest relative difference of objectives.
        hz: largest difference of frequency violations.
    """

    method: str
    settings: str
    model: str
    regime: str
    tell: Callable[[str], None]
    rows: int = 0
    skipped: list[str] = field(default_factory=list)
    differences: list[str] = field(default_factory=list)
    objective: float = 0.0
    hz: float = 0.0

    @property
    def name(self) -> str:
        """As its sentences call it."""
        return " ".join(filter(None, (self.method, self.settings, self.model, self.regime)))

    def note(self, kind: list[str], sentence: str) -> None:
        """Add a sentence to those of its kind."""
        kind.append(sentence)
        self.tell(f"{self.name}: {sentence}")


def reproduce(
    case: Case,
    instances: Mapping[str, Instance],
    results: Results,
    methods: Sequence[str] = (),
    sample: int = 5,
    workers: int = 1,
    on_sentence: Callable[[str], None] = lambda sentence: None,
) -> list[Sampled]:
    """Solve a sample of rows again and compare; the folder stays as it is.

    Args:
        case: of the rows.
        instances: by id; rows of others are skipped.
        results: whose rows are solved again; models and policies of the same folder come first.
        methods: only rows of these; none: of all.
        sample: rows of each line, drawn with a fixed seed.
        workers: processes.
        on_sentence: called with everything that differs or is skipped.

    Raises:
        InputError: there is no row of these methods.
    """
    parts: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in results.rows.values():
        if row.case == case.id and (not methods or row.method in methods):
            name = row.method, row.settings, model_name(row.model), row.regime
            parts.setdefault(name, []).append(row)
    if not parts:
        raise InputError(results.path, "method", f"has no rows of {', '.join(methods) or case.id}")
    lines = [Sampled(*name, on_sentence) for name in sorted(parts)]
    tasks: list[tuple[Sampled, Row, Task]] = []
    for line in lines:
        chosen = _sample(line, parts[line.method, line.settings, line.model, line.regime], instances, sample)
        tasks += [
            (line, row, task) for row in chosen if (task := _task(case, line, row, instances, results.folder))
        ]
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as folder:
        solved = run(case, [task for *_, task in tasks], Results(folder), workers)
    for (line, row, _), again in zip(tasks, solved, strict=True):
        _compare(line, row, again)
    return lines


def _sample(line: Sampled, rows: Sequence[Row], instances: Mapping[str, Instance], count: int) -> list[Row]:
    """Rows to be solved again; what cannot be is noted."""
    unlike = [r for r in rows if r.objective is None or r.status in (Status.TIME_LIMIT, Status.FAILED)]
    if unlike:
        named = ", ".join(row.instance for row in unlike[:5]) + (", …" if len(unlike) > 5 else "")
        line.note(line.skipped, f"{len(unlike)} of {len(rows)} rows failed or ended by a limit ({named})")
    known = sorted((r for r in rows if r not in unlike and r.instance in instances), key=lambda r: r.key[1:7])
    if not known and len(unlike) < len(rows):
        line.note(line.skipped, "its instances are unknown here")
    return random.Random(f"{SEED} {line.name}").sample(known, min(count, len(known)))


def _task(
    case: Case, line: Sampled, row: Row, instances: Mapping[str, Instance], folder: Path
) -> Task | None:
    """The task that makes a row; None, and noted why, if the folder has not what made it."""
    if line.method not in registered():
        line.note(line.skipped, f"{row.instance}: no method has this name")
        return None
    if line.model not in ("", *MODELS):
        line.note(line.skipped, f"{row.instance}: made with a model of its own ({row.model})")
        return None
    search = search_folders(case, folder)
    settings = Settings(line.settings, line.model, time_limit_s=row.time_limit_s, search=search)
    try:
        (task,) = make_tasks(
            case, [(instances[row.instance], row.split)], [line.method], [line.regime], settings
        )
    except InputError as error:
        line.note(line.skipped, f"{row.instance}: {error}")
        return None
    if task.key.policy != row.policy or (line.model in TRAINED and task.key.model != row.model):
        line.note(line.skipped, f"{row.instance}: its {row.policy or row.model} is not the one in {folder}")
        return None
    return task


def _compare(line: Sampled, row: Row, again: Row) -> None:
    """Note whether a row that was solved again is as before."""
    if again.status == Status.TIME_LIMIT:
        line.note(line.skipped, f"{row.instance}: ended by its limit this time")
        return
    line.rows += 1
    apart = dict.fromkeys(LIMITS, 0.0) | differences(row, again, dict.fromkeys(LIMITS, 0.0))
    line.objective = max(line.objective, apart["objective"])
    if again.objective is None:
        line.note(line.differences, f"{row.instance}: no score this time ({again.error or again.status})")
        return
    line.hz = max(line.hz, apart["freq_violation_hz"])
    if any(apart[name] > limit for name, limit in LIMITS.items()):
        said = (f"{name} {getattr(row, name)!r}, now {getattr(again, name)!r}" for name in LIMITS)
        line.note(line.differences, f"{row.instance}: {'; '.join(said)}")


def table_of(lines: Sequence[Sampled]) -> str:
    """One line each: rows, how many differ, the largest differences."""
    cells = []
    for line in lines:
        numbers = line.rows, len(line.differences), f"{line.objective:.1e}", f"{line.hz:.1e}"
        cells.append((line.method, line.settings, line.model or "-", line.regime, *numbers))
    heads = ["method", "settings", "model", "regime", "rows", "differ", "objective", "Hz"]
    return pd.DataFrame(cells, columns=heads).to_string(index=False)
