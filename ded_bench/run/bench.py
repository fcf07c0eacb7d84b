"""Times of methods alone on the machine, in turns: one process and thread each, one computing at a time.

Every method and regime has a process of its own. In each round every method gets one turn: it answers a
warm-up instance, untimed, and then all timed instances in a row, so that its calls find memory caches as
they are in use, not as the other methods left them. A method's turns are spread over the run, in an order
that rotates, so that a passing disturbance meets few of its calls. Python's garbage collector waits while a
call is timed, as in `timeit`. `timing.csv` holds one row per call and one run: a new run replaces the table
when it is complete. Times of the results table, taken while several workers share the machine, never enter
it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import hashlib
import itertools
import math
import os
import resource
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ded_bench.analysis.summary import in_own_table
from ded_bench.files.errors import InputError
from ded_bench.methods.registry import Method, get_method, registered
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key, Results, Row
from ded_bench.results.timing import PARTS, TIMING, WARM_UP, TimingRow, read_timing
from ded_bench.run.code import code_of_method, named
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.tasks import failed
from ded_bench.surrogates.find import MODELS

#: Instances that are timed, unless the caller says otherwise.
SAMPLE = 10
#: How many rounds a method takes part in, as in `timeit.Timer.autorange`: the least of these numbers whose
#: calls come to so many seconds, the largest for a method that is faster still.
ROUNDS, ENOUGH_S = (1, 2, 5, 10), 5.0
#: Changes with the way in which calls are timed: a run that was timed in another way is timed anew.
PROCEDURE = "all instances in a row"


class Job(NamedTuple):
    """A method that is timed, in one regime."""

    method: str
    regime: str
    settings: Settings


class Call(NamedTuple):
    """One call of a method: its answer, its wall-clock seconds, and what was so when it ended.

    Attributes:
        load_average: of the machine.
        peak_memory_mib: the most that the method's process has held so far; None if the process died.
    """

    solution: Solution
    seconds: float | None
    load_average: float
    peak_memory_mib: float | None = None


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
        warm_up: answered first in each turn, untimed; none of the timed instances.
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
    with contextlib.closing(_Turns(case, run, facts, warm_up, results)) as turns:
        rows = _go(turns, instances, kept, rounds, partial)
    TIMING.write(path, rows)
    partial.unlink(missing_ok=True)
    return rows


def rounds_of(rows: Iterable[TimingRow]) -> int:
    """How many rounds a method takes part in, from its calls of the first round; 1 if one of them failed."""
    seconds = [ENOUGH_S if row.call_s is None or row.error else row.call_s for row in rows]
    return next((count for count in ROUNDS if count * sum(seconds) >= ENOUGH_S), ROUNDS[-1])


class _Turns:
    """The processes of a run, and what its rows have in common."""

    def __init__(
        self,
        case: Case,
        run: str,
        facts: Mapping[Job, Mapping[str, str]],
        warm_up: Instance,
        results: Results | None,
    ) -> None:
        self.case, self.run, self.facts, self.warm_up, self.results = case, run, facts, warm_up, results
        self._pools = {job: Workers(1) for job in facts}

    def take(self, job: Job, round_: int, instances: Sequence[Instance]) -> list[TimingRow]:
        """One turn of one method: a row for its warm-up and for each instance."""
        first, *calls = self._ask(job, instances)
        rows = [self._row(job, round_, *pair) for pair in zip(instances, calls, strict=True)]
        return [self._row(job, WARM_UP, self.warm_up, first), *rows]

    def finish(self, job: Job) -> None:
        """End the process of a method that has no further turn: on large grids it holds gigabytes."""
        self._pools[job].close()

    def close(self) -> None:
        """End all processes."""
        for job in self._pools:
            self.finish(job)

    def _ask(self, job: Job, instances: Sequence[Instance]) -> list[Call]:
        """Warm-up and answers; where the process died, instance by instance, to find which one kills it."""
        asked = (self.case, *job, self.warm_up, tuple(instances))
        ((_, answer),) = self._pools[job].imap([(timed_turn, asked)], [None])
        if isinstance(answer, list):
            return answer
        lost = Call(failed(answer), None, os.getloadavg()[0])
        if len(instances) == 1:
            return [lost, lost]
        single = [self._ask(job, [instance]) for instance in instances]
        return [single[0][0], *(call for _, call in single)]

    def _row(self, job: Job, round_: int, instance: Instance, call: Call) -> TimingRow:
        solution = call.solution
        facts: dict[str, Any] = {name: getattr(solution, name) for name in PARTS} | dict(self.facts[job])
        return TimingRow(
            run=self.run,
            round=round_,
            regime=job.regime,
            method=job.method,
            settings=job.settings.slug,
            instance=instance.id,
            status=str(solution.status),
            call_s=call.seconds,
            schedule_difference_pu=self._difference(job, instance, solution.schedule),
            load_average=call.load_average,
            peak_memory_mib=call.peak_memory_mib,
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
    kept: Sequence[TimingRow],
    rounds: int | None,
    partial: Path,
) -> list[TimingRow]:
    """Run what is not kept yet, and save after every turn."""
    rows = {row.key: row for row in kept}
    present = list(turns.facts)
    for round_ in itertools.count(1):
        shift = (round_ - 1) % len(present)
        further = []
        order = present[shift:] + present[:shift]
        for job in tqdm(order, unit="turn", disable=None, desc=f"bench, round {round_}"):
            if (round_, job.regime, job.method, job.settings.slug, instances[-1].id) not in rows:
                for row in turns.take(job, round_, instances):
                    rows.setdefault(row.key, row)  # the warm-up of the first turn stands
                TIMING.write(partial, rows.values())
            first = (row for row in rows.values() if row.round == 1 and _name(row) == _name_of(job))
            if round_ < (rounds or rounds_of(first)):
                further.append(job)
            else:
                turns.finish(job)
        present = [job for job in turns.facts if job in further]
        if not present:
            break
    return list(rows.values())


def timed_turn(
    case: Case, method: str, regime: str, settings: Settings, warm_up: Instance, instances: Sequence[Instance]
) -> list[Call]:
    """Answer the warm-up instance and then all others, in this process; a call that fails is an answer, too.

    Garbage is collected between the calls; what the method keeps is not gone through each time, since that
    would empty the memory caches.
    """
    try:
        solve = _prepared(case, method, regime, settings)
    except Exception as error:
        return [Call(failed(error), None, os.getloadavg()[0])] * (1 + len(instances))
    gc.unfreeze()
    first = timed(solve, warm_up)
    gc.freeze()
    return [first, *(timed(solve, instance) for instance in instances)]


def timed(solve: Solver, instance: Instance) -> Call:
    """Answer one instance and time the whole call, without the garbage collector."""
    gc.collect()
    gc.disable()
    try:
        started = time.perf_counter()
        solution = solve(instance)
        elapsed = time.perf_counter() - started
        if solution.solve_s is None:  # a method that does not time itself is timed as a whole
            solution = dataclasses.replace(solution, solve_s=elapsed)
    except Exception as error:  # the boundary to other people's methods: a failure is a row
        return Call(failed(error), None, os.getloadavg()[0], _peak_memory_mib())
    finally:
        gc.enable()
    return Call(solution, elapsed, os.getloadavg()[0], _peak_memory_mib())


def _peak_memory_mib() -> float:
    """The most memory that this process has held, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, KiB elsewhere


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
    rows: Mapping[Key, Row], settings: Settings, methods: Mapping[str, Method] | None = None
) -> list[Job]:
    """What a results table holds, to be timed, in the methods' order.

    Rows of studies, of other methods and of models given as a file are left out. A method all of whose rows
    in a regime were made with a time limit has it, here as there: without it a call might take hours.

    Args:
        settings: all but the name, the model and the time limit, which come from the rows.
        methods: those to time, by the name that their rows carry; None: all that are registered.
    """
    methods = registered() if methods is None else methods
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for key, row in rows.items():
        limits = found.setdefault((key.method, key.settings), {}).setdefault(key.regime, [])
        limits.append(math.inf if row.time_limit_s is None else row.time_limit_s)
    jobs = []
    for method in methods:
        for slug in sorted(slug for name, slug in found if name == method and not in_own_table(slug)):
            known = methods[method].settings
            choices = [
                dataclasses.replace(settings, name=name, model=model) for name in known for model in MODELS
            ]
            match = next((choice for choice in choices if choice.slug == slug), None)
            if match is None:
                continue
            for regime, limits in sorted(found[method, slug].items()):
                limit = max(limits) if math.isfinite(max(limits)) else None
                jobs.append(Job(method, regime, dataclasses.replace(match, time_limit_s=limit)))
    return jobs


def choose_sample(instances: Sequence[Instance], count: int = SAMPLE) -> list[Instance]:
    """The instances to time: spread evenly over the given ones, the same every time."""
    if len(instances) <= count:
        return list(instances)
    return [instances[i] for i in np.linspace(0, len(instances) - 1, count).round().astype(int)]


def _name(row: TimingRow) -> tuple[str, str, str]:
    return row.method, row.settings, row.regime


def _name_of(job: Job) -> tuple[str, str, str]:
    return job.method, job.settings.slug, job.regime


def _facts(case: Case, job: Job) -> dict[str, str]:
    """What the rows of one method and regime have in common."""
    method = get_method(job.method)
    used = method.artifacts(case, job.regime, job.settings)
    shaped_by = {kind: named(used, kind) for kind in ("model", "policy")}
    made_by = {"code": code_of_method(method, job.settings.name, used), "version": version(), "host": host()}
    return shaped_by | made_by | {"case": case.id}


def _run_id(
    case: Case, instances: Sequence[Instance], facts: Mapping[Job, Mapping[str, str]], rounds: int | None
) -> str:
    """Twelve hex digits that change with all that a run's times depend on, but the day."""
    parts = [PROCEDURE, case.fingerprint, *(i.fingerprint for i in instances), str(rounds)]
    for job, fact in facts.items():
        parts += [*_name_of(job), str(job.settings.time_limit_s), *map(str, sorted(fact.items()))]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
