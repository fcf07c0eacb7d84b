"""Commands that make and judge schedules: solve, score."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import (
    DEFAULT_CASE,
    KNOWN,
    MODEL_HELP,
    command,
    names,
    positive,
    positive_number,
)
from ded_bench.files.errors import InputError
from ded_bench.koopman.surrogates import default_results, search_folders
from ded_bench.methods.solution import Settings
from ded_bench.problem.benchmark import SPLITS, Selection, select_files, select_split
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule

if TYPE_CHECKING:
    from ded_bench.run.results import Results, Row


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "solve", "solve instances with methods, score, one row each")
    p.add_argument(
        "--method", type=names, required=True, metavar="M[,M]", help=f"{KNOWN}, or module:function"
    )
    p.add_argument("--regime", type=names, required=True, metavar="R[,R]", help="NO, TO")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=SPLITS, default="test", help="default: test")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE", help="instead of a split")
    p.add_argument("--limit", type=positive, help="only the first so many of the split")
    p.add_argument("--case", help="name of a shipped case, or a folder")
    p.add_argument("--settings", default="default", help="slug of the method's settings")
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")
    where = p.add_mutually_exclusive_group()
    where.add_argument("--workers", type=positive, metavar="N", help="processes here (default: 1)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    p.add_argument(
        "--time-limit", type=positive_number, metavar="S", help="per solve; 60 s later it is killed"
    )
    p.add_argument("--out", type=Path, help="results folder")
    p.set_defaults(run=_solve)

    p = command(commands, "score", "simulate schedule CSVs on the true system and judge them")
    given = p.add_mutually_exclusive_group(required=True)
    given.add_argument("--schedule", type=Path, metavar="CSV", help="one, for one --instance")
    given.add_argument("--schedules", type=Path, metavar="DIR", help="[REGIME/]INSTANCE.csv[.gz] become rows")
    p.add_argument("--name", help="what the rows of --schedules call your method")
    p.add_argument("--regime", type=names, required=True, metavar="R[,R]", help="NO, TO")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=SPLITS, default="test", help="default: test")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE", help="instead of a split")
    p.add_argument("--limit", type=positive, help="only the first so many of the split")
    p.add_argument("--case", help="name of a shipped case, or a folder")
    p.add_argument("--workers", type=positive, default=1)
    p.add_argument("--out", type=Path, help="results folder for the rows of --schedules")
    p.add_argument("--json", action="store_true", help="one JSON object per schedule")
    p.set_defaults(run=_score)


def _solve(a: argparse.Namespace) -> int:
    from ded_bench.methods.registry import get_method
    from ded_bench.run.results import Results
    from ded_bench.run.runner import make_tasks, run
    from ded_bench.solvers.status import Status

    methods = [get_method(name).name for name in a.method]
    chosen = _chosen(a)
    case = chosen.case
    results = Results(a.out or default_results(case))
    settings = _settings(a, case, results.folder)
    tasks = make_tasks(case, chosen.instances, methods, a.regime, settings)

    def print_row(row: Row) -> None:
        if a.instance:
            _print_row(results, row)

    finished = [task.key for task in tasks if results.has(task.key, task.fingerprint)]
    for key in finished:
        print_row(results.rows[key])
    rows = run(case, tasks, results, a.workers or 1, chosen.version, print_row, a.scheduler)
    bad = [row for row in rows if row.status == Status.FAILED or row.objective is None]
    print(
        f"{len(rows)} rows in {results.path} "
        f"({len(finished)} were there already, {len(bad)} without a score)",
        file=sys.stderr,
    )
    return 1 if any(row.status == Status.FAILED for row in rows) else 0


def _score(a: argparse.Namespace) -> int:
    from ded_bench.truth.score import score
    from ded_bench.truth.simulate import SimulationError

    if a.schedules:
        return _score_folder(a)
    if len(a.instance or ()) != 1 or len(a.regime) != 1:
        raise InputError("--schedule", str(a.schedule), "needs one --instance and one --regime")
    chosen, (regime,) = _chosen(a), a.regime
    case, (instance, _) = chosen.case, chosen.instances[0]
    case.check_regimes([regime])
    schedule = Schedule.read(a.schedule, case, instance.horizon_s)
    try:
        verdict = score(case, instance, schedule, regime)
    except SimulationError as error:
        print(f"ded-bench: {a.schedule}: {error}", file=sys.stderr)
        return 1
    facts = dataclasses.asdict(verdict) | {
        "feasible": verdict.feasible,
        "feasible_strict": verdict.feasible_strict,
    }
    if a.json:
        print(json.dumps({"instance": instance.id, "regime": regime} | facts))
    else:
        for name, value in facts.items():
            print(f"{name:20} {value}")
    return 0


def _score_folder(a: argparse.Namespace) -> int:
    from ded_bench.run.results import Results
    from ded_bench.run.submit import submit

    if not a.name:
        raise InputError("--schedules", str(a.schedules), "needs a --name for the rows")
    chosen = _chosen(a)
    results = Results(a.out or default_results(chosen.case))
    done = submit(chosen, a.schedules, a.name, a.regime, results, a.workers)
    bad = [row for row in done.rows if row.objective is None]
    for row in bad[:10]:
        print(f"ded-bench: {row.regime} {row.instance}: {row.error}", file=sys.stderr)
    if done.unused:
        named = ", ".join(path.name for path in done.unused[:3])
        print(f"ded-bench: {len(done.unused)} files of other instances: {named}", file=sys.stderr)
    if a.json:
        for row in done.rows:
            _print_row(results, row)
    print(f"{len(done.rows)} rows in {results.path} ({len(bad)} without a score)", file=sys.stderr)
    return 1 if bad else 0


def _chosen(a: argparse.Namespace) -> Selection:
    """The instances of `--instance`, checked against the physics, or of `--split`."""
    from ded_bench.truth.network import check_servable
    from ded_bench.truth.servable import servable

    if not a.instance:
        return select_split(a.case or DEFAULT_CASE, a.split, a.limit, servable)
    chosen = select_files(a.instance, Case.load(a.case) if a.case else None)
    for path, (instance, _) in zip(a.instance, chosen.instances, strict=True):
        check_servable(chosen.case, instance, str(path))
    return chosen


def _print_row(results: Results, row: Row) -> None:
    """One JSON object: the row, and where its schedule lies."""
    path = results.schedule_path(row.key)
    scheduled = path.is_file() and row.status != "Failed"
    fields = dataclasses.asdict(row) | {"schedule": str(path) if scheduled else None}
    print(json.dumps(fields), flush=True)


def _settings(a: argparse.Namespace, case: Case, out: Path) -> Settings:
    return Settings(
        name=a.settings,
        model=a.model,
        policy=a.policy,
        time_limit_s=a.time_limit,
        search=search_folders(case, out),
    )
