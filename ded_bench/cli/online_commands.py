"""The command that operates scenarios: online."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import (
    add_methods,
    chosen_methods,
    command,
    counted,
    declare,
    names,
    positive,
    positive_number,
    say,
)
from ded_bench.files.errors import InputError
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import PLANTS, plant_of
from ded_bench.problem.benchmark import scenario_files
from ded_bench.problem.case import Case
from ded_bench.problem.instance import check_plausible
from ded_bench.problem.scenario import QUALITIES, Scenario, load_scenarios
from ded_bench.results.folder import ResultsFolder, default_results, search_folders

if TYPE_CHECKING:
    from ded_bench.results.online_results import OnlineRow
    from ded_bench.run.online.operation import Operation


def add_commands(commands: Any) -> None:
    """Declare this command and its options."""
    p = command(commands, "online", "operate scenarios with a method's plans, one row each")
    add_methods(p)
    declare(p, "--case", "--workers", "--out")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--scenarios", type=positive, metavar="N", help="only the first N of the case")
    chosen.add_argument("--scenario", type=Path, nargs="+", metavar="FILE", help="instead of the case's")
    period = "between plans (default: option `every` of a method, where it is set; else 1)"
    p.add_argument("--period", type=positive_number, metavar="S", help=period)
    latency = "timing, zero, or seconds"
    p.add_argument("--latency", type=names, default=("timing",), metavar="L[,L]", help=latency)
    qualities = ", ".join(QUALITIES)
    p.add_argument("--forecast", type=_qualities, default=QUALITIES[:1], metavar="F[,F]", help=qualities)
    p.add_argument(
        "--state",
        choices=("predicted", "present"),
        default="predicted",
        help="what plans start from: the state when they take effect, or the measured one",
    )
    p.add_argument("--plant", choices=PLANTS, help="what is operated; default: the case's own")
    p.add_argument("--cold", action="store_true", help="never start a method from its last plan")
    p.add_argument("--no-hindsight", action="store_true", help="look for no optimum of whole scenarios")
    p.add_argument("--time-limit", type=positive_number, metavar="S", help="per plan, of the clock (60 s)")
    p.set_defaults(run=_online)


def _qualities(text: str) -> tuple[str, ...]:
    """Read qualities of forecasts separated by commas."""
    for name in names(text):
        if name not in QUALITIES:
            raise argparse.ArgumentTypeError(f"{name}: not one of {', '.join(QUALITIES)}")
    return names(text)


def _online(a: argparse.Namespace) -> int:
    from ded_bench.results.online_results import OnlineResults
    from ded_bench.run.online.operation import operate

    case = Case.load(a.case)
    folder = a.out or default_results(case)
    scenarios = load_scenarios(a.scenario or scenario_files(case.folder / "scenarios", a.scenarios), case)
    for file, scenario in zip(a.scenario or (), scenarios, strict=False):  # the tests check those shipped
        check_plausible(case, first := scenario.snapshot(case, 0.0), file)
        plant_of(case, a.plant).check_servable(first, str(file))
    methods = chosen_methods(a, search_folders(case, folder))
    if "timing" in a.latency and not _timed(a, case, methods):
        return 1
    operations = _operations(a, case, methods, scenarios)
    say(f"{counted(len(operations), 'row')} asked for, each a scenario of some minutes")
    rows = operate(case, operations, OnlineResults(folder), a.workers, _print_row, not a.no_hindsight)
    from ded_bench.cli.outcome import tell_operated

    tell_operated(rows, ResultsFolder(folder))
    return 1 if any(row.objective is None for row in rows) else 0


def _operations(
    a: argparse.Namespace, case: Case, methods: Sequence[tuple[str, Settings]], scenarios: Sequence[Scenario]
) -> list[Operation]:
    """Every row asked for: all methods, then the next latency or forecast."""
    from ded_bench.run.online.loop import LIMIT_S, PERIOD_S, LoopOptions
    from ded_bench.run.online.operation import make_operations

    made: list[Operation] = []
    for forecast, latency, method in itertools.product(a.forecast, a.latency, methods):
        period_s = a.period or get_method(method[0]).interval_s(method[1]) or PERIOD_S
        options = LoopOptions(period_s, forecast=forecast, predict=a.state == "predicted", warm=not a.cold)
        asked = case, scenarios, method, a.regime or tuple(case.regimes), options, latency
        made += make_operations(*asked, a.time_limit or LIMIT_S, a.plant)
    return made


def _timed(a: argparse.Namespace, case: Case, methods: Sequence[tuple[str, Settings]]) -> bool:
    """Time methods whose times no results folder has; whether all have an answer to be timed."""
    from ded_bench.run.bench import FEW, Job, measure
    from ded_bench.run.online.operation import timed_latency

    case.check_regimes(a.regime or ())
    for (name, settings), regime in itertools.product(methods, a.regime or case.regimes):
        try:
            timed_latency(case, get_method(name), regime, settings)
        except InputError:
            say(f"{name} {regime} is not timed yet: its latency is measured on {FEW} drawn instances first")
            rows = measure(case, Job(name, regime, settings), ResultsFolder(settings.search[0]).latency)
            if not any(row.counts for row in rows):
                say(f"{name} {regime} has no answer to any of them: {rows[-1].error}")
                return False
    return True


def _print_row(row: OnlineRow) -> None:
    name = f"{row.scenario} {row.regime} {row.method} {row.settings} {row.latency_s:.3g} s:"
    if row.objective is None or row.max_excess_hz is None:
        print(f"{name} {row.error}", flush=True)
        return
    over = "no hindsight" if row.increase_percent is None else f"{row.increase_percent:.4f} % over hindsight"
    if (row.increase_percent or 0.0) < 0 < row.max_excess_hz:
        over += " (less than it, since the bound is exceeded)"
    plans = f"{row.late} late, {row.failed} failed, {row.infeasible} infeasible of {row.plans}"
    print(f"{name} {over}, largest excess {1e3 * row.max_excess_hz:.4f} mHz, {plans}", flush=True)
