"""Times of methods alone on the machine, in turns: one process and thread each, one computing at a time.

Every method and regime keeps a process of its own, which answers a warm-up instance first. Then come
rounds over the timed instances; on each instance all methods answer, one after the other, in an order that
rotates. What disturbs the machine for a while thus disturbs all methods alike. `timing.csv` holds one row
per call and one run: a new run replaces the table when it is complete. Times of the results table, taken
while several workers share the machine, never enter it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from tqdm import tqdm

from ded_bench.evaluate.summary import in_own_table, quartiles
from ded_bench.files.errors import InputError
from ded_bench.files.table import Table, cell
from ded_bench.koopman.surrogates import MODELS
from ded_bench.methods.registry import Method, get_method, registered
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.code import code_of_method
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.results import Key, Results
from ded_bench.run.tasks import failed

#: Instances that are timed, unless the caller says otherwise.
SAMPLE = 10
#: A method takes part in further rounds while all its rounds together stay within so many seconds, at most
#: in so many rounds. The first round of all instances is always run.
BUDGET_S, MAX_ROUNDS = 30.0, 10
#: Round of a process's first call, on the warm-up instance; it enters no median.
WARM_UP = 0
PARTS = ("build_s", "setup_s", "solve_s")


class Job(NamedTuple):
    """A method that is timed, in one regime."""

    method: str
    regime: str
    settings: Settings


@dataclass(frozen=True)
class TimingRow:
    """One call of one method, wall-clock seconds.

    `call_s` is the whole call as its process saw it, `load_average` the machine's over the last minute,
    when the call ended: at most about 1 if bench was alone. `schedule_difference_pu` is max |ΔP| between
    this call's schedule and the one that the results folder keeps.
    """

    run: str
    round: int
    regime: str
    method: str
    settings: str
    instance: str
    status: str
    build_s: float | None = cell(default=None, lowest=0)
    setup_s: float | None = cell(default=None, lowest=0)
    solve_s: float | None = cell(default=None, lowest=0)
    call_s: float | None = cell(default=None, lowest=0)
    schedule_difference_pu: float | None = cell(default=None, lowest=0)
    load_average: float | None = cell(default=None, lowest=0)
    error: str = ""
    model: str = ""
    policy: str = ""
    code: str = ""
    case: str = ""
    problems_version: str = ""
    version: str = ""
    solver_version: str = ""
    host: str = ""
    date: str = ""

    @property
    def key(self) -> tuple[int, str, str, str, str]:
        """What makes a row unique within its run."""
        return self.round, self.regime, self.method, self.settings, self.instance


TIMING: Table[TimingRow] = Table(TimingRow)


def bench(
    case: Case,
    instances: Sequence[Instance],
    jobs: Sequence[Job],
    path: Path,
    *,
    warm_up: Instance,
    results: Results | None = None,
    rounds: int | None = None,
    force: bool = False,
    problems_version: str = "",
) -> list[TimingRow]:
    """Time methods in turns and keep every call in a table.

    A run that was interrupted goes on where it was; its rows lie beside the table until it is complete. A
    complete run of the same methods, instances and host is not repeated unless `force`.

    Args:
        path: of the table, which holds one run.
        warm_up: answered first by each process, untimed; none of the timed instances.
        results: where schedules are kept that those computed here are compared with.
        rounds: how often every method answers every instance; None: chosen by its speed (see `rounds_of`).

    Returns:
        All rows of the run, in the order in which they were made.

    Raises:
        InputError: no instance, no method, an unknown method, regime or settings, a missing model or policy,
            or a table of a run of other methods.
    """
    if not instances or not jobs:
        raise InputError("instances", "", "at least one instance and one method are needed")
    if warm_up.id in {instance.id for instance in instances}:
        raise InputError(f"instance {warm_up.id}", "", "cannot be timed, since it warms up")
    case.check_regimes([job.regime for job in jobs])
    facts = {job: _facts(case, job) | {"problems_version": problems_version} for job in jobs}
    run = _run_id(case, instances, facts, rounds)
    there = read_timing(path)
    if not force and there and {row.run for row in there} == {run}:
        return there
    others = {_name(row) for row in there} - {_name_of(job) for job in jobs}
    if others:
        method, _, regime = sorted(others)[0]
        raise InputError(
            path, "method", f"holds a run that timed others too ({method} in {regime}); write elsewhere"
        )
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    kept = [] if force else [row for row in read_timing(partial) if row.run == run]
    with contextlib.ExitStack() as stack:
        turns = _Turns(case, run, facts, {job: stack.enter_context(Workers(1)) for job in jobs}, results)
        rows = _go(turns, instances, warm_up, kept, rounds, partial)
    TIMING.write(path, rows)
    partial.unlink(missing_ok=True)
    return rows


def rounds_of(rows: Iterable[TimingRow]) -> int:
    """How many rounds a method takes part in, from its calls of the first round, which are warm.

    As many as fit into BUDGET_S, from 1 to MAX_ROUNDS; 1 if a call failed, MAX_ROUNDS without any.
    """
    seconds = [BUDGET_S if row.call_s is None or row.error else row.call_s for row in rows]
    return max(1, min(MAX_ROUNDS, int(BUDGET_S / max(sum(seconds), 1e-9))))


class _Turns:
    """The processes of a run, and what its rows have in common."""

    def __init__(
        self,
        case: Case,
        run: str,
        facts: Mapping[Job, Mapping[str, str]],
        pools: Mapping[Job, Workers],
        results: Results | None,
    ) -> None:
        self.case, self.run, self.facts, self.pools, self.results = case, run, facts, pools, results
        self.warm: set[Job] = set()

    def call(self, job: Job, round_: int, instance: Instance) -> TimingRow:
        """One answer of one method as a row."""
        arguments = (self.case, job.method, job.regime, job.settings, instance)
        ((_, answer),) = self.pools[job].imap([(timed, arguments)], [None])
        solution, seconds = answer if isinstance(answer, tuple) else (failed(answer), None)
        if seconds is None:  # its process may have been replaced
            self.warm.discard(job)
        facts: dict[str, Any] = {name: getattr(solution, name) for name in PARTS} | dict(self.facts[job])
        return TimingRow(
            run=self.run,
            round=round_,
            regime=job.regime,
            method=job.method,
            settings=job.settings.slug,
            instance=instance.id,
            status=str(solution.status),
            call_s=seconds,
            schedule_difference_pu=self._difference(job, instance, solution.schedule),
            load_average=os.getloadavg()[0],
            error="" if solution.schedule is not None else solution.error or solution.status.sentence,
            solver_version=solution.solver_version,
            date=now(),
            **facts,
        )

    def _difference(self, job: Job, instance: Instance, schedule: Schedule | None) -> float | None:
        key = Key(instance.id, job.regime, job.method, job.settings.slug)
        if schedule is None or self.results is None or not self.results.schedule_path(key).is_file():
            return None
        return largest_difference(schedule, self.results.schedule(key, self.case, instance))


def _go(
    turns: _Turns,
    instances: Sequence[Instance],
    warm_up: Instance,
    kept: Sequence[TimingRow],
    rounds: int | None,
    partial: Path,
) -> list[TimingRow]:
    """Run what is not kept yet, and save after every instance of every round."""
    rows = {row.key: row for row in kept}
    jobs = list(turns.facts)
    turn = 0
    for round_ in range(1, (rounds or MAX_ROUNDS) + 1):
        made = [row for row in rows.values() if row.round == 1 and rounds is None and round_ > 1]
        present = [j for j in jobs if round_ <= rounds_of(r for r in made if _name(r) == _name_of(j))]
        if not present:
            break
        for instance in tqdm(instances, unit="instance", disable=None, desc=f"bench, round {round_}"):
            turn += 1
            shift = turn % len(present)
            for job in present[shift:] + present[:shift]:
                key = (round_, job.regime, job.method, job.settings.slug, instance.id)
                if key in rows:
                    continue
                if job not in turns.warm:
                    turns.warm.add(job)
                    first = turns.call(job, WARM_UP, warm_up)
                    rows.setdefault(first.key, first)
                rows[key] = turns.call(job, round_, instance)
            TIMING.write(partial, rows.values())
    return list(rows.values())


def timed(
    case: Case, method: str, regime: str, settings: Settings, instance: Instance
) -> tuple[Solution, float]:
    """Answer one instance in this process; returns the solution and the seconds of the whole call."""
    solve = _prepared(case, method, regime, settings)
    started = time.perf_counter()
    solution = solve(instance)
    elapsed = time.perf_counter() - started
    if solution.solve_s is None:  # a method that does not time itself is timed as a whole
        solution = dataclasses.replace(solution, solve_s=elapsed)
    return solution, elapsed


@functools.lru_cache(maxsize=1)
def _prepared(case: Case, method: str, regime: str, settings: Settings) -> Solver:
    solve = get_method(method).prepare(case, regime, settings)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    return solve


def largest_difference(a: Schedule, b: Schedule) -> float:
    """max |ΔP| of two schedules over their common span, pu; both are linear between their points."""
    times = np.union1d(a.t, b.t)
    times = times[times <= min(a.t[-1], b.t[-1])]
    return float(np.abs(a.at(times) - b.at(times)).max())


def runs_of(
    keys: Iterable[Key], settings: Settings, methods: Mapping[str, Method] | None = None
) -> list[Job]:
    """What a results table holds, to be timed, in the methods' order.

    Rows of studies, of other methods and of models given as a file are left out.

    Args:
        settings: all but the name and the model, which come from the keys.
        methods: those to time, by the name that their rows carry; None: all that are registered.
    """
    methods = registered() if methods is None else methods
    found: dict[tuple[str, str], set[str]] = {}
    for key in keys:
        found.setdefault((key.method, key.settings), set()).add(key.regime)
    jobs = []
    for method in methods:
        for slug in sorted(slug for name, slug in found if name == method and not in_own_table(slug)):
            known = methods[method].settings
            choices = [
                dataclasses.replace(settings, name=name, model=model) for name in known for model in MODELS
            ]
            match = next((choice for choice in choices if choice.slug == slug), None)
            if match is not None:
                jobs += [Job(method, regime, match) for regime in sorted(found[method, slug])]
    return jobs


def choose_sample(instances: Sequence[Instance], count: int = SAMPLE) -> list[Instance]:
    """The instances to time: spread evenly over the given ones, the same every time."""
    if len(instances) <= count:
        return list(instances)
    return [instances[i] for i in np.linspace(0, len(instances) - 1, count).round().astype(int)]


def read_timing(path: Path) -> list[TimingRow]:
    """Read a timing table; no rows if there is no such file.

    Raises:
        InputError: a column is missing, or a value is wrong; names line and column.
    """
    return TIMING.read(path) if path.exists() else []


def timing_summary(rows: Sequence[TimingRow]) -> pd.DataFrame:
    """Median and quartiles per (case, regime, method, settings) over instances and rounds, s.

    The first call of each process enters as `first_…` alone; calls that failed count in `failures` and
    enter no median. `load_average` is the median of the calls', `schedule_difference_pu` the largest.
    """
    parts: dict[tuple[str, ...], list[TimingRow]] = {}
    for row in rows:
        parts.setdefault((row.case, row.regime, row.method, row.settings), []).append(row)
    found = [_summary(calls) for calls in parts.values()]
    frame = pd.DataFrame(found, columns=list(SUMMARY_COLUMNS))
    numbers = [name for name in SUMMARY_COLUMNS if name.endswith(("_s", "_q1", "_q3", "_pu", "_average"))]
    return frame.astype(dict.fromkeys(numbers, "float64"))


_NAMES = ("case", "problems_version", "version", "solver_version", "host", "date", "model", "policy", "code")
SUMMARY_COLUMNS = (
    *("regime", "method", "settings", "instances", "repeats", "failures"),
    *(f"{name}{end}" for name in reversed(PARTS) for end in ("", "_q1", "_q3")),
    *(f"first_{name}" for name in PARTS),
    *("load_average", "schedule_difference_pu", "error", "run", *_NAMES),
)


def _summary(calls: Sequence[TimingRow]) -> dict[str, Any]:
    first = next((row for row in calls if row.round == WARM_UP), None)
    warm = [row for row in calls if row.round != WARM_UP]
    good = [row for row in warm if not row.error]
    last = calls[-1]
    errors = [row.error for row in warm if row.error]
    facts: dict[str, Any] = {
        "regime": last.regime,
        "method": last.method,
        "settings": last.settings,
        "instances": len({row.instance for row in warm}),
        "repeats": max((row.round for row in warm), default=0),
        "failures": len(errors),
        "load_average": float(np.median(_values(warm, "load_average") or [np.nan])),
        "schedule_difference_pu": max(_values(warm, "schedule_difference_pu"), default=None),
        "error": "" if good or not errors else errors[0],
        "run": last.run,
    }
    facts |= {f"first_{name}": getattr(first, name, None) for name in PARTS}
    for name in PARTS:
        facts |= quartiles(name, np.array(_values(good, name), dtype=float))
    return facts | {name: getattr(last, name) for name in _NAMES}


def _values(rows: Sequence[TimingRow], name: str) -> list[float]:
    return [value for row in rows if (value := getattr(row, name)) is not None]


def _name(row: TimingRow) -> tuple[str, str, str]:
    return row.method, row.settings, row.regime


def _name_of(job: Job) -> tuple[str, str, str]:
    return job.method, job.settings.slug, job.regime


def _facts(case: Case, job: Job) -> dict[str, str]:
    """What the rows of one method and regime have in common."""
    method = get_method(job.method)
    used = method.artifacts(case, job.regime, job.settings)
    named = {
        kind: "+".join(f"{a.name}@{a.fingerprint}" for a in used if a.kind == kind)
        for kind in ("model", "policy")
    }
    made_by = {"code": code_of_method(method, used), "version": version(), "host": host()}
    return named | made_by | {"case": case.id}


def _run_id(
    case: Case, instances: Sequence[Instance], facts: Mapping[Job, Mapping[str, str]], rounds: int | None
) -> str:
    """Twelve hex digits that change with all that a run's times depend on, but the day."""
    parts = [case.fingerprint, *(i.fingerprint for i in instances), str(rounds)]
    for job, fact in facts.items():
        parts += [*_name_of(job), str(job.settings.time_limit_s), *map(str, sorted(fact.items()))]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
