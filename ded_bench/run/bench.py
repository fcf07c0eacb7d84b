"""Times of methods alone on the machine, in turns: one process and thread each, one computing at a time.

Every job, a method with its settings in a regime, has a process of its own. In each round every job gets one
turn: it answers a warm-up instance, untimed, and then all timed instances in a row, so that its calls find
memory caches as they are in use, not as the other methods left them. A job's turns are spread over the run,
in an order that rotates, so that a passing disturbance meets few of its calls. Python's garbage collector
waits while a call is timed, as in `timeit`. `timing.csv` holds one row per call and one run: a new run
replaces the table when it is complete. Times of the results table, taken while several workers share the
machine, never enter it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import hashlib
import itertools
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import locked
from ded_bench.files.strict import check_writable
from ded_bench.methods.registry import Method, get_method
from ded_bench.methods.solution import Settings, Solution, Solver, named
from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import validation_instances
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.rows import Key, Row
from ded_bench.results.timing import TIMING, WARM_UP, TimingRow, model_name
from ded_bench.run.environment import commit, host, now, version
from ded_bench.run.pool import Workers
from ded_bench.run.runner import GRACE_S
from ded_bench.run.tasks import failed, prepared
from ded_bench.surrogates.find import MODELS

#: Drawn instances that tell a latency where nobody timed the method.
FEW = 3
#: How many rounds a job takes part in, as in `timeit.Timer.autorange`: the least of these numbers whose
#: calls come to so many seconds, the largest for a method that is faster still.
ROUNDS, ENOUGH_S = (1, 2, 5, 10), 5.0
#: Changes with the way in which calls are timed: a run that was timed in another way is timed anew.
PROCEDURE = "all instances in a row"

#: Cells of a `TimingRow` that one call fills.
Told = dict[str, Any]


class Job(NamedTuple):
    """A method that is timed, in one regime."""

    method: str
    regime: str
    settings: Settings


def bench(
    case: Case,
    instances: Sequence[Instance],
    jobs: Sequence[Job],
    path: Path,
    *,
    warm_up: Instance,
    rounds: int | None = None,
    force: bool = False,
    problems_version: str = "",
) -> list[TimingRow]:
    """Time jobs in turns and keep every call in a table.

    A run that was interrupted goes on where it was; its rows lie beside the table until it is complete. A
    complete run of the same jobs, instances and host is not repeated unless `force`.

    Args:
        case: of the instances.
        instances: what is timed.
        jobs: what is timed on them.
        path: of the table, which holds one run.
        warm_up: answered first in each turn, untimed; none of the timed instances.
        rounds: how often every job answers every instance; None: chosen by its speed (see `rounds_of`).
        force: time again what the table holds.
        problems_version: of the problem files.

    Returns:
        All rows of the run, in the order in which they were made.

    Raises:
        InputError: no instance, no job, an unknown method, regime or options, a missing model or policy,
            a table of a run of other jobs, or one that cannot be written.
    """
    if not instances or not jobs:
        raise InputError("instances", "", "at least one instance and one method are needed")
    if warm_up.id in {instance.id for instance in instances}:
        raise InputError(f"instance {warm_up.id}", "", "cannot be timed, since it warms up")
    case.check_regimes([job.regime for job in jobs])
    own = {job: _template(case, job, problems_version) for job in jobs}
    run = _run_id(case, instances, own, rounds)
    if (there := _complete(path, run, {row.job for row in own.values()})) and not force:
        return there
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    check_writable(partial)
    kept = [] if force else [row for row in TIMING.existing(partial) if row.run == run]
    rows = {row.key: row for row in kept}

    def rounds_for(job: Job) -> int:
        first = [row for row in rows.values() if row.round == 1 and row.job == own[job].job]
        return rounds or (rounds_of(first) if first else 1)

    with contextlib.ExitStack() as stack:
        pools = {job: stack.enter_context(contextlib.closing(Workers(1))) for job in jobs}
        for round_ in itertools.count(1):
            present = [job for job in jobs if round_ <= rounds_for(job)]
            if not present:
                break
            shift = (round_ - 1) % len(present)
            order = present[shift:] + present[:shift]
            for job in tqdm(order, unit="turn", disable=None, desc=f"bench, round {round_}"):
                if (round_, *own[job].job, instances[-1].id) not in rows:
                    row = dataclasses.replace(own[job], run=run, round=round_)
                    for made in _turn(pools[job], case, job, row, warm_up, instances):
                        rows.setdefault(made.key, made)  # the first turn's warm-up stands
                    TIMING.write(partial, rows.values())
                if round_ >= rounds_for(job):
                    pools[job].close()  # on large grids a process holds gigabytes
    TIMING.write(path, rows.values())
    partial.unlink(missing_ok=True)
    return list(rows.values())


def _complete(path: Path, run: str, jobs: set[tuple[str, str, str, str]]) -> list[TimingRow]:
    """The rows of a table if it holds this very run; InputError if it holds other jobs, too."""
    there = TIMING.existing(path)
    if others := {row.job for row in there} - jobs:
        regime, method, *_ = sorted(others)[0]
        problem = f"holds a run that timed others, too ({method} in {regime}); write elsewhere"
        raise InputError(path, "method", problem)
    return there if {row.run for row in there} == {run} else []


def _turn(
    pool: Workers, case: Case, job: Job, row: TimingRow, warm_up: Instance, instances: Sequence[Instance]
) -> Iterator[TimingRow]:
    """The rows of one turn of a job, made from one with its run and round: the warm-up's, then the others."""
    calls = _ask(pool, case, job, warm_up, instances)
    for instance, call in zip([warm_up, *instances], calls, strict=True):
        number = WARM_UP if instance is warm_up else row.round
        yield dataclasses.replace(row, round=number, instance=instance.id, **call)


def measure(case: Case, job: Job, path: Path) -> list[TimingRow]:
    """Time one job on drawn instances, and add its calls to a table of several runs; returns them."""
    warm_up, *instances = validation_instances(case, 1 + FEW, servable=servable)
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as name:
        rows = bench(case, instances, [job], Path(name) / "timing.csv", warm_up=warm_up, rounds=1)
    with locked(path.parent):
        TIMING.write(path, [*TIMING.existing(path), *rows])
    return rows


def rounds_of(rows: Iterable[TimingRow]) -> int:
    """How many rounds a job takes part in, from its calls of the first round; 1 if one of them failed."""
    seconds = [ENOUGH_S if row.call_s is None or row.error else row.call_s for row in rows]
    return next((count for count in ROUNDS if count * sum(seconds) >= ENOUGH_S), ROUNDS[-1])


def _template(case: Case, job: Job, problems_version: str) -> TimingRow:
    """A row of a job, without what only a call can tell."""
    method = get_method(job.method)
    settings = method.canonical(job.settings)
    used = method.artifacts(case, job.regime, settings)
    return TimingRow(
        *("", WARM_UP, job.regime, method.name, settings.options, "", ""),
        model=named(used, "model"),
        policy=named(used, "policy"),
        case=case.id,
        problems_version=problems_version,
        version=version(),
        commit=commit(),
        method_version=method.version,
        host=host(),
    )


def _run_id(
    case: Case, instances: Sequence[Instance], own: Mapping[Job, TimingRow], rounds: int | None
) -> str:
    """Twelve hex digits that change with all that a run's times depend on, but the day and the commit."""
    parts = [PROCEDURE, case.fingerprint, *(i.fingerprint for i in instances), str(rounds)]
    for job, row in own.items():
        parts += [str(job.settings.time_limit_s), str(dataclasses.replace(row, commit=""))]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]


def _ask(pool: Workers, case: Case, job: Job, warm_up: Instance, instances: Sequence[Instance]) -> list[Told]:
    """Warm-up and answers; where the process died, instance by instance, to find which one kills it."""
    limit_s = job.settings.time_limit_s
    limit_s = limit_s and (limit_s + GRACE_S) * (1 + len(instances))
    ((_, answer),) = pool.imap([(timed_turn, (case, *job, warm_up, tuple(instances)))], [None], [limit_s])
    if isinstance(answer, list):
        return answer
    if len(instances) == 1:
        return [_told(failed(answer))] * 2
    single = [_ask(pool, case, job, warm_up, [instance]) for instance in instances]
    return [single[0][0], *(call for _, call in single)]


def _told(solution: Solution, seconds: float | None = None, peak_memory: float | None = None) -> Told:
    """What a call that has just ended tells of its row; `peak_memory` of its process, None if that died."""
    return {
        "status": str(solution.status),
        "build_s": solution.build_s,
        "setup_s": solution.setup_s,
        "solve_s": solution.solve_s,
        "call_s": seconds,
        "load_average": round(os.getloadavg()[0], 2),
        "peak_memory_mib": peak_memory,
        "error": "" if solution.schedule is not None else solution.error or solution.status.sentence,
        "solver_version": solution.solver_version,
        "date": now(),
    }


def timed_turn(
    case: Case, method: str, regime: str, settings: Settings, warm_up: Instance, instances: Sequence[Instance]
) -> list[Told]:
    """Answer the warm-up instance and then all others, in this process; a call that fails is an answer, too.

    Garbage is collected between the calls; what the method keeps is not gone through each time, since that
    would empty the memory caches.
    """
    try:
        solve = prepared(case, method, regime, settings)
    except Exception as error:
        return [_told(failed(error))] * (1 + len(instances))
    gc.unfreeze()
    first = timed(solve, warm_up)
    gc.freeze()
    return [first, *(timed(solve, instance) for instance in instances)]


def timed(solve: Solver, instance: Instance) -> Told:
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
        return _told(failed(error), None, _peak_memory_mib())
    finally:
        gc.enable()
    return _told(solution, elapsed, _peak_memory_mib())


def _peak_memory_mib() -> float:
    """The most memory that this process has held, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)  # bytes there, KiB elsewhere


def runs_of(rows: Iterable[Row], settings: Settings, methods: Mapping[str, Method]) -> list[Job]:
    """What a results table holds, to be timed, in the methods' order.

    Rows of other methods and those `not_timed` are left out. A job all of whose rows were made with a time
    limit has it, here as there: without it a call might take hours.

    Args:
        rows: of the table.
        settings: all but the options, the model and the time limit, which come from the rows.
        methods: those to time, by the name that their rows carry.
    """
    limits: dict[tuple[str, str, str, str], list[float | None]] = {}
    for row in rows:
        if row.method in methods and not not_timed(row.key, methods[row.method]):
            model = model_name(row.model)
            own = dataclasses.replace(settings, options=row.settings, model=model)
            options = methods[row.method].canonical(own).options
            limits.setdefault((row.method, options, model, row.regime), []).append(row.time_limit_s)
    order = list(methods)
    jobs = []
    for key in sorted(limits, key=lambda key: (order.index(key[0]), *key[1:])):
        method, options, model, regime = key
        given = [limit for limit in limits[key] if limit is not None]
        limit = max(given) if len(given) == len(limits[key]) else None
        own = dataclasses.replace(settings, options=options, model=model, time_limit_s=limit)
        jobs.append(Job(method, regime, own))
    return jobs


def not_timed(key: Key, method: Method) -> str:
    """Why what made a row cannot be timed, empty if it can; rows may be of another version."""
    if model_name(key.model) not in ("", *MODELS):
        return "its model was given as a file"
    try:
        method.canonical(Settings(key.settings))
    except InputError as error:
        return str(error)
    return ""


def choose_sample(instances: Sequence[Instance], count: int) -> list[Instance]:
    """The instances to time: spread evenly over the given ones, the same every time."""
    places = np.linspace(0, len(instances) - 1, min(count, len(instances)))
    return [instances[i] for i in places.round().astype(int)]
