"""Times of methods alone on the machine: one process, one thread, warmed up; Table V's time column.

`timing.csv` holds one row per (regime, method, settings, host). Times of the results table, taken
while several workers share the machine, never enter it.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from ded_bench.evaluate.summary import is_apart, quartiles
from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.koopman.surrogates import MODELS
from ded_bench.methods.registry import Method, get_method, registered
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.results import LARGEST, Key, read_table
from ded_bench.run.tasks import failed

#: Instances that are timed, unless the caller says otherwise.
SAMPLE = 10
#: Without a number of repeats, a method is repeated until this much solve time is spent, at most so often.
BUDGET_S, MAX_REPEATS = 2.0, 200
PARTS = ("build_s", "setup_s", "solve_s")


@dataclass(frozen=True)
class TimingRow:
    """Median and quartiles of one method over instances × repeats, wall-clock seconds.

    `first_build_s` and `first_setup_s` are what the untimed first solve of the process paid once.
    `load_average` is the machine's, when the timing of this row began: at most about 1 if it was alone.
    """

    regime: str
    method: str
    settings: str
    instances: int
    repeats: int
    failures: int
    solve_s: float | None = None
    solve_s_q1: float | None = None
    solve_s_q3: float | None = None
    build_s: float | None = None
    build_s_q1: float | None = None
    build_s_q3: float | None = None
    setup_s: float | None = None
    setup_s_q1: float | None = None
    setup_s_q3: float | None = None
    first_build_s: float | None = None
    first_setup_s: float | None = None
    load_average: float | None = None
    error: str = ""
    case: str = ""
    problems_version: str = ""
    version: str = ""
    solver_version: str = ""
    host: str = ""
    date: str = ""
    fingerprint: str = ""

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What makes a row unique."""
        return self.regime, self.method, self.settings, self.host


COLUMNS = tuple(field.name for field in dataclasses.fields(TimingRow))
_TYPES = {field.name: str(field.type).removesuffix(" | None") for field in dataclasses.fields(TimingRow)}
_OPTIONAL = {field.name for field in dataclasses.fields(TimingRow) if "None" in str(field.type)}


def bench_methods(
    case: Case,
    instances: Sequence[Instance],
    methods: Sequence[str],
    regimes: Sequence[str],
    settings: Settings,
    repeats: int | None = None,
    *,
    kept: Sequence[TimingRow] = (),
    problems_version: str = "",
    on_row: Callable[[TimingRow], None] = lambda row: None,
) -> list[TimingRow]:
    """Time methods one after the other, each in a fresh process with one thread.

    Args:
        repeats: how often every instance is solved; None: chosen by the method's speed.
        kept: rows of earlier runs; those made here for the same inputs are not timed again.
        on_row: called with every new row as soon as it exists.

    Returns:
        One row per method and regime, old and new.

    Raises:
        InputError: no instance, unknown method, regime or settings, or a missing model or policy.
    """
    if not instances:
        raise InputError("instances", "", "at least one is needed to time a method")
    case.check_regimes(regimes)
    jobs = []
    for method in methods:
        for regime in regimes:
            artifacts = get_method(method).artifacts(case, regime, settings)
            parts = [case.fingerprint, *(i.fingerprint for i in instances)]
            parts += [regime, method, settings.slug, *(a.fingerprint for a in artifacts), str(repeats)]
            jobs.append((method, regime, hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]))
    known = {(row.key, row.fingerprint): row for row in kept if not row.error}
    rows = []
    with tqdm(jobs, unit="method", disable=None, desc="bench") as bar:
        for method, regime, fingerprint in bar:
            bar.set_postfix_str(f"{method} {regime}")
            key = (regime, method, settings.slug, host())
            row = known.get((key, fingerprint))
            if row is None:
                row = _row(case, instances, method, regime, settings, repeats)
                row = dataclasses.replace(row, fingerprint=fingerprint, problems_version=problems_version)
                on_row(row)
            rows.append(row)
    return rows


def bench_folder(
    folder: Path,
    case: Case,
    instances: Sequence[Instance],
    methods: Sequence[str],
    regimes: Sequence[str],
    settings: Settings,
    *,
    repeats: int | None = None,
    force: bool = False,
    problems_version: str = "",
) -> list[TimingRow]:
    """Time methods and keep the rows in `<folder>/timing.csv`, saved one by one.

    Rows of the same method, inputs and host stay as they are unless `force`.
    """
    path = folder / "timing.csv"
    table = {row.key: row for row in read_timing(path)}

    def save(row: TimingRow) -> None:
        table[row.key] = row
        write_atomically(path, format_timing(list(table.values())))

    kept = [] if force else list(table.values())
    return bench_methods(
        case,
        instances,
        methods,
        regimes,
        settings,
        repeats,
        kept=kept,
        problems_version=problems_version,
        on_row=save,
    )


def runs_of(
    keys: Iterable[Key], settings: Settings, methods: Mapping[str, Method] | None = None
) -> list[tuple[str, list[str], Settings]]:
    """What a results table holds, to be timed: (method, regimes, settings), in the methods' order.

    Rows of studies are not timed. Rows of other methods, and of models given as a file, cannot be run
    again from their key alone and are left out.

    Args:
        settings: all but the name and the model, which come from the keys.
        methods: those to time, by the name that their rows carry; None: all that are registered.
    """
    methods = registered() if methods is None else methods
    found: dict[tuple[str, str], set[str]] = {}
    for key in keys:
        found.setdefault((key.method, key.settings), set()).add(key.regime)
    runs = []
    for method in methods:
        for slug in sorted(slug for name, slug in found if name == method and not is_apart(slug)):
            known = methods[method].settings
            choices = [
                dataclasses.replace(settings, name=name, model=model) for name in known for model in MODELS
            ]
            match = next((choice for choice in choices if choice.slug == slug), None)
            if match is not None:
                runs.append((method, sorted(found[method, slug]), match))
    return runs


def choose_sample(instances: Sequence[Instance], count: int = SAMPLE) -> list[Instance]:
    """The instances to time: spread evenly over the given ones, the same every time."""
    if len(instances) <= count:
        return list(instances)
    return [instances[i] for i in np.linspace(0, len(instances) - 1, count).round().astype(int)]


@dataclass(frozen=True)
class Measured:
    """Raw times of one method, made in its own process."""

    first: Solution
    solutions: tuple[Solution, ...]  # without their schedules
    repeats: int
    load_average: float


def measure(
    case: Case,
    instances: Sequence[Instance],
    method: str,
    regime: str,
    settings: Settings,
    repeats: int | None,
) -> Measured:
    """Solve every instance `repeats` times in this process, after one solve that is not timed."""
    load_average = os.getloadavg()[0]
    solve = get_method(method).prepare(case, regime, settings)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)

    def timed(instance: Instance) -> Solution:
        started = time.perf_counter()
        solution = solve(instance)
        elapsed = time.perf_counter() - started
        # A method that does not time itself is timed as a whole.
        seconds = elapsed if solution.solve_s is None else solution.solve_s
        return dataclasses.replace(solution, schedule=None, solve_s=seconds, error=_problem(solution))

    first = timed(instances[0])
    if repeats is None:
        repeats = max(1, min(MAX_REPEATS, int(BUDGET_S / max((first.solve_s or 0.0) * len(instances), 1e-9))))
    solutions = [timed(instance) for _ in range(repeats) for instance in instances]
    return Measured(first, tuple(solutions), repeats, load_average)


def _problem(solution: Solution) -> str:
    if solution.schedule is not None:
        return ""
    return solution.error or solution.status.sentence


def _row(
    case: Case,
    instances: Sequence[Instance],
    method: str,
    regime: str,
    settings: Settings,
    repeats: int | None,
) -> TimingRow:
    call = (measure, (case, instances, method, regime, settings, repeats))
    with Workers(1) as pool:
        (_, answer), *_ = pool.imap([call], [method])
    facts: dict[str, Any] = {"case": case.id, "version": version(), "host": host(), "date": now()}
    row = TimingRow(regime, method, settings.slug, len(instances), 0, len(instances), **facts)
    if not isinstance(answer, Measured):
        return dataclasses.replace(row, error=failed(answer).error)
    good = [s for s in answer.solutions if not s.error]
    errors = [s.error for s in answer.solutions if s.error]
    spread: dict[str, Any] = {}
    for part in PARTS:
        values = np.array([v for s in good if (v := getattr(s, part)) is not None], dtype=float)
        spread |= quartiles(part, values) if len(values) else {}
    return dataclasses.replace(
        row,
        repeats=answer.repeats,
        failures=len(errors),
        first_build_s=answer.first.build_s,
        first_setup_s=answer.first.setup_s,
        load_average=answer.load_average,
        error="" if good else errors[0],
        solver_version=answer.first.solver_version,
        **spread,
    )


def latest_host(timing: pd.DataFrame) -> pd.DataFrame:
    """The rows of one host only, the one timed last: times of several are never mixed."""
    if not len(timing):
        return timing
    newest = timing.sort_values("date", kind="stable")["host"].iloc[-1]
    chosen: pd.DataFrame = timing[timing["host"] == newest]
    return chosen


def timing_frame(rows: Sequence[TimingRow]) -> pd.DataFrame:
    """The timing table, typed columns; empty cells are missing values."""
    frame = pd.DataFrame([dataclasses.astuple(row) for row in rows], columns=list(COLUMNS))
    for name, kind in _TYPES.items():
        if kind == "float":
            frame[name] = frame[name].astype("float64")
    return frame


def format_timing(rows: Sequence[TimingRow]) -> str:
    """Rows as CSV text; floats keep every digit, missing values are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if value is None else str(value) for value in dataclasses.astuple(row)])
    return text.getvalue()


def read_timing(path: Path) -> list[TimingRow]:
    """Read a timing table; no rows if there is no such file.

    Raises:
        InputError: a column is missing or unknown, or a value is wrong; names line and column.
    """
    if not path.exists():
        return []
    return [
        TimingRow(**{name: _parse(cell, name, path, number) for name, cell in cells.items()})
        for number, cells in read_table(path, COLUMNS)
    ]


def _parse(cell: str, name: str, path: Path, line: int) -> Any:
    kind = _TYPES[name]
    if kind == "str":
        if not cell and name in ("regime", "method", "settings", "host"):
            raise InputError(path, f"line {line}, {name}", "must not be empty")
        return cell
    if not cell and name in _OPTIONAL:
        return None
    try:
        value = int(cell) if kind == "int" else float(cell)
        if not 0 <= value <= LARGEST:
            raise ValueError
        return value
    except ValueError:
        raise InputError(path, f"line {line}, {name}", f"{cell[:30]!r} is not a valid value") from None
