"""Operate scenario × regime × method: resume, workers, hindsight first, one row each."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.table import LARGEST
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.online.ac_plant import AcPlant
from ded_bench.problem.ac_case import TRUTHS, AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Scenario
from ded_bench.results.online_results import (
    HindsightKey,
    HindsightRow,
    OnlineFiles,
    OnlineKey,
    OnlineResults,
    OnlineRow,
    keep_trajectory,
)
from ded_bench.run.code import code_of, code_of_method, named
from ded_bench.run.environment import host, now, version
from ded_bench.run.online import hindsight as hindsight_module
from ded_bench.run.online import loop as loop_module
from ded_bench.run.online.hindsight import hindsight
from ded_bench.run.online.judgement import Judgement, judge_operation
from ded_bench.run.online.latency import timed_latency
from ded_bench.run.online.loop import LoopOptions, run_loop
from ded_bench.run.online.planner import LIMIT_S, Planner
from ded_bench.run.online.record import Grid, Plant
from ded_bench.run.online.unforeseen import unforeseen_hz
from ded_bench.run.pool import Workers
from ded_bench.run.tasks import reason_of

#: Settings and models whose plans start from angles of the AC network: they stand for it.
AC_ANGLES = {"ac", "trajectory-ac"}


@dataclass(frozen=True)
class Operation:
    """One row to be made."""

    scenario: Scenario
    regime: str
    method: str
    settings: Settings
    options: LoopOptions
    limit_s: float
    latency_source: str
    artifacts: tuple[Artifact, ...]
    fingerprint: str
    code: str
    data: AcCase | None = None  # operate the full AC network

    @property
    def truth(self) -> str:
        """Which network is operated."""
        return TRUTHS[self.data is not None]

    @property
    def plans_on_ac(self) -> bool:
        """Whether plans are made with a model in which angles are those of the AC network."""
        return bool({self.settings.name, *(a.name for a in self.artifacts)} & AC_ANGLES)

    @property
    def key(self) -> OnlineKey:
        """The row's place in the table."""
        o = self.options
        name = self.scenario.id, self.regime, self.method, self.settings.slug
        return OnlineKey(*name, o.period_s, o.latency_s, o.forecast, o.predict, o.warm, self.truth)


def make_operations(
    case: Case,
    scenarios: Sequence[Scenario],
    methods: Sequence[tuple[str, Settings]],
    regimes: Sequence[str],
    options: LoopOptions,
    latency: str,
    timing: Sequence[Path],
    limit_s: float = LIMIT_S,
    data: AcCase | None = None,
) -> list[Operation]:
    """List every row of a run, a method's together.

    Args:
        methods: names with their settings.
        options: of the loop; its latency is replaced.
        latency: `timing`, `zero`, or seconds.
        timing: results folders whose `timing.csv` may tell the latency.
        limit_s: how long a method may take for a plan, s of the clock.
        data: of the case's AC network, to operate that.

    Raises:
        InputError: unknown method, regime or settings, a model or policy that is missing, or no latency.
    """
    case.check_regimes(regimes)
    operations, ac = [], () if data is None else (data.fingerprint,)
    for name, settings in methods:
        method = get_method(name)
        for regime in regimes:
            artifacts = method.artifacts(case, regime, settings)
            timed = dataclasses.replace(settings, name=method.timed_as(settings.name))
            seconds, source = _latency(case, (regime, method.name, timed.slug), latency, timing)
            own = dataclasses.replace(options, latency_s=seconds)
            code = code_of_method(method, settings.name, artifacts)
            shared = own, limit_s, source, artifacts
            for scenario in scenarios:
                fingerprint = _fingerprint(
                    case, scenario, *(a.fingerprint for a in artifacts), f"{limit_s:g}", *ac
                )
                operations.append(
                    Operation(scenario, regime, method.name, settings, *shared, fingerprint, code, data)
                )
    return operations


def operate(
    case: Case,
    operations: Sequence[Operation],
    results: OnlineResults,
    workers: int = 1,
    on_row: Callable[[OnlineRow], None] = lambda row: None,
) -> list[OnlineRow]:
    """Operate what the results folder lacks; every row is saved as soon as it exists.

    Returns:
        The rows of all operations, old and new, in their order.

    Raises:
        WorkersLostError: the workers cannot run this package.
    """
    todo = [o for o in operations if not results.table.made_from(o.key, o.fingerprint)]
    with Workers(workers) as pool:
        _look_back(case, todo, results, pool)
        calls = ((operate_one, (case, o, results.files)) for o in todo)
        with tqdm(total=len(todo), unit="scenario", disable=None, desc="online") as bar:
            for operation, answer in pool.imap(calls, todo):
                row = answer if isinstance(answer, OnlineRow) else _row(operation, error=reason_of(answer))
                row = _compared(row, results)
                results.table.add([row])
                on_row(row)
                bar.update()
    return [results.table.rows[o.key] for o in operations]


def operate_one(case: Case, operation: Operation, files: OnlineFiles) -> OnlineRow:
    """Operate one scenario in this process, and keep its trajectory."""
    o, started = operation, time.perf_counter()
    planner = Planner(case, o.regime, o.method, o.settings, o.limit_s)
    plant: Grid = Plant(case, o.scenario)
    if o.data is not None:
        plant = AcPlant(case, o.scenario, o.data, not o.plans_on_ac)
    outcome = run_loop(case, o.scenario, planner, o.options, plant)
    judgement = judge_operation(case, o.scenario, outcome.trajectory, o.regime)
    keep_trajectory(files.trajectory(o.key), outcome.trajectory)
    row = _row(o, judgement, reason_of(outcome.error) if outcome.error else "")
    loop_s = time.perf_counter() - started - outcome.method_s
    return dataclasses.replace(
        row,
        unforeseen_hz=unforeseen_hz(case, o.scenario, o.options, plant),
        plans=outcome.plans,
        late=outcome.late,
        failed=outcome.failed,
        infeasible=outcome.infeasible,
        warm_used=outcome.warm,
        method_s=outcome.method_s,
        loop_s=loop_s,
    )


def look_back(
    case: Case, scenario: Scenario, regime: str, data: AcCase | None, files: OnlineFiles
) -> HindsightRow:
    """Optimise one scenario with full knowledge in this process, and keep its trajectory."""
    found, row = hindsight(case, scenario, regime, data), _hindsight_row(case, scenario, regime, data)
    keep_trajectory(files.hindsight_trajectory(scenario.id, regime, row.truth), found.trajectory)
    return dataclasses.replace(
        row,
        method=found.method,
        objective=found.judgement.objective,
        max_excess_hz=found.judgement.max_excess_hz,
        slack_travel_pu=found.judgement.slack_travel_pu,
    )


def _look_back(case: Case, todo: Sequence[Operation], results: OnlineResults, pool: Workers) -> None:
    """Find the hindsight of every scenario and regime that is not there yet."""
    wanted = [_hindsight_row(case, o.scenario, o.regime, o.data) for o in todo]
    new = {
        row.key: (o.scenario, o.regime, o.data)
        for o, row in zip(todo, wanted, strict=True)
        if not results.hindsight.made_from(row.key, row.fingerprint)
    }
    missing = list(new.values())
    calls = ((look_back, (case, *one, results.files)) for one in missing)
    for (scenario, regime, data), answer in tqdm(
        pool.imap(calls, missing), total=len(missing), unit="scenario", disable=None, desc="hindsight"
    ):
        row = answer
        if not isinstance(row, HindsightRow):
            row = dataclasses.replace(_hindsight_row(case, scenario, regime, data), error=reason_of(answer))
        results.hindsight.add([row])


def _compared(row: OnlineRow, results: OnlineResults) -> OnlineRow:
    """A row with its cost over hindsight, where both are known."""
    best = results.hindsight.rows[HindsightKey(row.scenario, row.regime, row.truth)].objective
    if row.objective is None or not best:
        return row
    return dataclasses.replace(row, increase_percent=100 * (row.objective / best - 1))


def _row(o: Operation, judgement: Judgement | None = None, error: str = "") -> OnlineRow:
    numbers = {} if judgement is None else dataclasses.asdict(judgement)
    if any(not abs(value) <= LARGEST for value in numbers.values()):
        numbers, error = {}, f"cost or violations are above {LARGEST:g}"
    return OnlineRow(
        **o.key._asdict(),
        **numbers,
        error=error,
        limit_s=o.limit_s,
        latency_source=o.latency_source,
        case=o.scenario.case,
        model=named(o.artifacts, "model"),
        policy=named(o.artifacts, "policy"),
        fingerprint=o.fingerprint,
        code=o.code,
        online_code=code_of(loop_module.__name__),
        version=version(),
        host=host(),
        date=now(),
    )


def _hindsight_row(case: Case, scenario: Scenario, regime: str, data: AcCase | None) -> HindsightRow:
    ac = () if data is None else (data.fingerprint,)
    return HindsightRow(
        scenario=scenario.id,
        regime=regime,
        truth=TRUTHS[data is not None],
        case=case.id,
        fingerprint=_fingerprint(case, scenario, *ac),
        online_code=code_of(hindsight_module.__name__),
        version=version(),
        host=host(),
        date=now(),
    )


def _latency(
    case: Case, name: tuple[str, str, str], latency: str, timing: Sequence[Path]
) -> tuple[float, str]:
    if latency == "timing":
        return timed_latency(case, *name, timing), "timing"
    if latency == "zero":
        return 0.0, "zero"
    try:
        seconds = float(latency)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= LARGEST:
        raise InputError("--latency", latency, "is neither timing nor zero nor a number of at least 0")
    return seconds, "given"


def _fingerprint(case: Case, scenario: Scenario, *parts: str) -> str:
    """Twelve hex digits that change with case, scenario and what else decides on a row."""
    text = "|".join([case.fingerprint, scenario.fingerprint, *parts])
    return hashlib.sha256(text.encode()).hexdigest()[:12]
