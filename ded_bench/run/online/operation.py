"""Operate scenario × regime × method: resume, workers, hindsight first, one row each."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.strict import check_writable
from ded_bench.files.table import LARGEST
from ded_bench.methods.registry import Method, get_method
from ded_bench.methods.solution import Settings, named
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Scenario
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.online_results import (
    HindsightRow,
    Judgement,
    OnlineResults,
    OnlineRow,
    keep_trajectory,
)
from ded_bench.results.timing import TIMING, model_name
from ded_bench.run.environment import commit, host, now, version
from ded_bench.run.online.judgement import hindsight, judge_operation, unforeseen_hz
from ded_bench.run.online.loop import LIMIT_S, LoopOptions, Planner, run_loop
from ded_bench.run.pool import Workers
from ded_bench.run.tasks import reason_of


@dataclass(frozen=True)
class Operation:
    """One row to be made. `settings` are canonical, `row` is all that is known of it before."""

    scenario: Scenario
    settings: Settings
    options: LoopOptions
    row: OnlineRow


def make_operations(
    case: Case,
    scenarios: Sequence[Scenario],
    asked: tuple[str, Settings],
    regimes: Sequence[str],
    options: LoopOptions,
    latency: str,
    limit_s: float = LIMIT_S,
    plant: str | None = None,
) -> list[Operation]:
    """List every row of a run of one method.

    Args:
        case: the grid.
        scenarios: to be operated.
        asked: the method's name and its settings; their folders may tell the latency, too.
        regimes: of the case.
        options: of the loop; its latency is replaced.
        latency: `timing`, `zero`, or seconds.
        limit_s: how long a method may take for a plan, s of the clock.
        plant: name of what is operated; None: the case's own.

    Raises:
        InputError: unknown method, regime, options or plant, no model or policy, or no latency.
    """
    case.check_regimes(regimes)
    operated = plant_of(case, plant)
    operations = []
    method = get_method(asked[0])
    settings = method.canonical(asked[1])
    for regime in regimes:
        artifacts = method.artifacts(case, regime, settings)
        model, policy = named(artifacts, "model"), named(artifacts, "policy")
        seconds, source = _latency(latency, functools.partial(timed_latency, case, method, regime, settings))
        longest = max(options.horizon_s, method.interval_s(settings) or 0.0)
        own = dataclasses.replace(options, latency_s=seconds, horizon_s=longest)
        for scenario in scenarios:
            made_from = *(a.fingerprint for a in artifacts), f"{limit_s:g}"
            row = OnlineRow(
                *(scenario.id, regime, method.name, settings.options),
                period_s=own.period_s,
                latency_s=seconds,
                forecast=own.forecast,
                predicted=own.predict,
                warm=own.warm,
                plant=operated.name,
                **_made(case, operated.name, scenario, *made_from),
                model=model,
                policy=policy,
                limit_s=limit_s,
                latency_source=source,
                method_version=method.version,
            )
            operations.append(Operation(scenario, settings, own, row))
    return operations


def operate(
    case: Case,
    operations: Sequence[Operation],
    results: OnlineResults,
    workers: int = 1,
    on_row: Callable[[OnlineRow], None] = lambda row: None,
    look_back: bool = True,
) -> list[OnlineRow]:
    """Operate what the results folder lacks; every row is saved as soon as it exists.

    Args:
        case: the grid.
        operations: rows to be made.
        results: where they are kept.
        workers: processes.
        on_row: is told of every new row.
        look_back: whether hindsight is found where it is missing; else costs may stand beside none.

    Returns:
        The rows of all operations, old and new, in their order.

    Raises:
        InputError: the folder cannot be written, or rows were taken away meanwhile.
        WorkersLostError: the workers cannot run this package.
        OSError: a trajectory cannot be kept.
    """
    table = results.table
    if todo := [o for o in operations if not _is_there(table, o.row)]:
        check_writable(table.path)
    with Workers(workers) as pool:
        if look_back:
            _look_back(case, operations, results, pool)
        calls = ((operate_one, (case, o, results.files)) for o in todo)
        with tqdm(total=len(todo), unit="scenario", disable=None, desc="online") as bar:
            for operation, answer in pool.imap(calls, todo):
                if isinstance(answer, OSError):
                    raise answer  # the folder refuses, which is nothing of the method's
                row = answer if isinstance(answer, OnlineRow) else _row(operation, error=reason_of(answer))
                row = _compared(case, operation, row, results)
                table.add([row])
                on_row(row)
                bar.update()
    made = table.asked(o.row.key for o in operations)
    rows = [_compared(case, o, row, results) for o, row in zip(operations, made, strict=True)]
    if later := [row for row in rows if row != table.rows[row.key]]:
        table.add(later)  # hindsight that was found after them
    table.compact()
    return table.asked(o.row.key for o in operations)


def operate_one(case: Case, operation: Operation, files: ResultsFolder) -> OnlineRow:
    """Operate one scenario in this process, and keep its trajectory."""
    o, asked, plant = operation, operation.row, plant_of(case, operation.row.plant)
    try:  # before the clock starts: it loads what is compiled
        unforeseen = unforeseen_hz(case, o.scenario, o.options, plant)
    except SimulationError:  # nobody answers to them there, as plans do
        unforeseen = None
    started = time.perf_counter()
    planner = Planner(case, asked.regime, asked.method, o.settings, asked.limit_s or LIMIT_S)
    trajectory, answers, method_s, plant_s = run_loop(case, o.scenario, planner, o.options, plant)
    judgement = judge_operation(case, o.scenario, trajectory, asked.regime)
    keep_trajectory(files.trajectory(asked.key), trajectory)
    missing = [answer for answer in answers if answer.schedule is None]
    for answer in missing[:1]:
        what = f"online {asked.method} {asked.regime} {asked.scenario}"
        files.log_failure(what, answer.trace or answer.error)
    reason = reason_of(missing[0].error) if missing else ""
    row = _row(o, judgement, reason)
    if answers and len(missing) == len(answers):  # what happened then is no result of the method
        row = _row(o, None, f"every plan failed: {reason}")
    loop_s = time.perf_counter() - started - method_s
    return dataclasses.replace(
        row,
        unforeseen_hz=unforeseen,
        plans=len(answers),
        late=sum(answer.late for answer in missing),
        failed=sum(not answer.late for answer in missing),
        infeasible=sum(answer.infeasible and answer.schedule is not None for answer in answers),
        warm_used=any(answer.warm for answer in answers),
        method_s=method_s,
        loop_s=loop_s,
        plant_s=plant_s,
    )


def find_hindsight(case: Case, scenario: Scenario, row: HindsightRow, files: ResultsFolder) -> HindsightRow:
    """Optimise one scenario with full knowledge in this process, and keep its trajectory."""
    method, judgement, trajectory = hindsight(case, scenario, row.regime, plant_of(case, row.plant))
    keep_trajectory(files.hindsight_trajectory(*row.key), trajectory)
    cells = {name: getattr(judgement, name) for name in ("objective", "max_excess_hz", "slack_travel_pu")}
    return dataclasses.replace(row, method=method, method_version=get_method(method).version, **cells)


def _look_back(case: Case, asked_for: Sequence[Operation], results: OnlineResults, pool: Workers) -> None:
    """Find the hindsight of every scenario and regime that is not there yet."""
    asked = {(o.row.scenario, o.row.regime, o.row.plant): o.scenario for o in asked_for}
    wanted = [
        (scenario, HindsightRow(*key, **_made(case, key[2], scenario))) for key, scenario in asked.items()
    ]
    rows = results.hindsight.rows
    missing = [one for one in wanted if not _is_there(results.hindsight, one[1]) or _is_old(rows[one[1].key])]
    calls = ((find_hindsight, (case, *one, results.files)) for one in missing)
    for (_, row), answer in tqdm(
        pool.imap(calls, missing), total=len(missing), unit="scenario", disable=None, desc="hindsight"
    ):
        failed = dataclasses.replace(row, error=reason_of(answer))
        results.hindsight.add([answer if isinstance(answer, HindsightRow) else failed])


def _is_there(table: KeyedTable[Any, Any], row: OnlineRow | HindsightRow) -> bool:
    """Whether a row was made, by no older version if it says which, and did not fail."""
    made = table.made_from(row.key, row.fingerprint, row.method_version)
    return made and table.rows[row.key].objective is not None


def _is_old(row: HindsightRow) -> bool:
    """Whether another version of its method would find it today; 0 is unknown."""
    return row.method_version not in (0, get_method(row.method).version)


def _compared(case: Case, o: Operation, row: OnlineRow, results: OnlineResults) -> OnlineRow:
    """A row with its cost over the hindsight of the same loads, where both are known."""
    best = results.hindsight.rows.get((row.scenario, row.regime, row.plant))
    if row.objective is None or best is None or not best.objective:
        return row
    if best.fingerprint != _made(case, row.plant, o.scenario)["fingerprint"]:
        return row
    return dataclasses.replace(row, increase_percent=100 * (row.objective / best.objective - 1))


def _row(o: Operation, judgement: Judgement | None = None, error: str = "") -> OnlineRow:
    numbers = {} if judgement is None else dataclasses.asdict(judgement)
    if any(value is not None and not abs(value) <= LARGEST for value in numbers.values()):
        numbers, error = {}, f"cost or violations are above {LARGEST:g}"
    return dataclasses.replace(o.row, **numbers, error=error, date=now())


def _made(case: Case, plant: str, scenario: Scenario, *parts: str) -> dict[str, Any]:
    """What makes a row, where and when; `parts`: what else decides on it."""
    # A plant whose data are the case's has its fingerprint, which then counts once.
    data = dict.fromkeys([case.fingerprint, plant_of(case, plant).fingerprint])
    text = "|".join([*data, scenario.fingerprint, *parts])
    facts = {"case": case.id, "fingerprint": hashlib.sha256(text.encode()).hexdigest()[:12]}
    return facts | {"version": version(), "commit": commit(), "host": host(), "date": now()}


def _latency(latency: str, timed: Callable[[], float]) -> tuple[float, str]:
    """Seconds from measurement to plan, and where they are from; `timed` tells those of `timing`."""
    if latency == "timing":
        return timed(), "timing"
    if latency == "zero":
        return 0.0, "zero"
    try:
        seconds = float(latency)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= LARGEST:
        raise InputError("--latency", latency, "is neither timing nor zero nor a number of at least 0")
    return seconds, "given"


def timed_latency(case: Case, method: Method, regime: str, settings: Settings) -> float:
    """Median build and solve time in the tables of the first folder that timed a method's present version, s.

    Raises:
        InputError: none of the folders has such times (names the command that makes them).
    """
    model = model_name(named(method.artifacts(case, regime, settings), "model"))
    job = regime, method.name, method.canonical(settings).options, model
    for folder in settings.search:
        paths = ResultsFolder(folder)
        rows = [*TIMING.existing(paths.timing), *TIMING.existing(paths.latency)]
        times = [
            (row.build_s or 0.0) + (row.solve_s or 0.0)
            for row in rows
            if (row.case, row.job) == (case.id, job)
            and row.counts
            and row.method_version in (0, method.version)  # 0: of older tables
        ]
        if times:
            return float(np.median(times))
    problem = "is not timed; run `ded-bench bench`, or give --latency in seconds"
    raise InputError("--latency timing", " ".join(filter(None, (*job[1:], job[0]))), problem)
