"""Commands that make schedules, judge them and solve rows again: solve, score, reproduce, referee."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import (
    CASE_HELP,
    DEFAULT_CASE,
    add_instances,
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
from ded_bench.files.strict import check_writable
from ded_bench.plants.plant import PLANTS, SimulationError, plant_of, servable
from ded_bench.problem.benchmark import Selection, check_own_name, instance_file, select_files, select_split
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance, check_plausible
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import default_results, search_folders
from ded_bench.solvers.status import Status

if TYPE_CHECKING:
    from ded_bench.results.rows import Results, Row


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "solve", "solve instances with methods, score, one row each")
    add_methods(p)
    add_instances(p)
    declare(p, "--out")
    where = p.add_mutually_exclusive_group()
    where.add_argument("--workers", type=positive, metavar="N", help="processes here (default: 1)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    limit = "per solve; 120 s later it is killed"
    p.add_argument("--time-limit", type=positive_number, metavar="S", help=limit)
    p.set_defaults(run=_solve)

    p = command(commands, "score", "simulate schedules on a plant and judge them")
    given = p.add_mutually_exclusive_group(required=True)
    given.add_argument("--schedule", type=Path, metavar="CSV", help="one, for one --instance")
    given.add_argument("--schedules", type=Path, metavar="DIR", help="[REGIME/]INSTANCE.csv[.gz] become rows")
    given.add_argument("--results", type=Path, metavar="DIR", help="compare its rows and kept schedules")
    p.add_argument("--update", action="store_true", help="write the new scores into the rows of --results")
    p.add_argument("--plant", choices=PLANTS, help="default: that of the rows; another: validated.csv")
    p.add_argument("--name", help="what the rows of --schedules call your method")
    p.add_argument("--regime", type=names, metavar="R[,R]", help="of the case; not for --results")
    add_instances(p)
    declare(p, "--workers")
    p.add_argument("--out", type=Path, help="results folder for the rows of --schedules")
    p.add_argument("--json", action="store_true", help="one JSON object per schedule")
    p.set_defaults(run=_score)

    p = command(commands, "reproduce", "solve a sample of rows again and compare")
    p.add_argument("--sample", type=positive, default=5, metavar="N", help="rows per method and settings")
    p.set_defaults(run=_reproduce)
    q = command(commands, "referee", "ANDES, the field's simulator, judges kept schedules: referee.csv")
    of_many = "of instances, those with most schedules first"
    q.add_argument("--limit", type=positive, metavar="N", help=of_many)
    q.add_argument("--python", default=sys.executable, metavar="PATH", help="one that has ANDES")
    q.set_defaults(run=_referee)
    for one in (p, q):
        one.add_argument("--results", type=Path, required=True, metavar="DIR", help="whose rows are meant")
        one.add_argument("--method", type=names, default=(), metavar="M[,M]", help="default: all in it")
        one.add_argument("--case", help=f"{CASE_HELP}; default: that of the rows")
        declare(one, "--workers")
        one.set_defaults(instance=None)


def _solve(a: argparse.Namespace) -> int:
    from ded_bench.cli.outcome import tell_solved
    from ded_bench.results.rows import Results
    from ded_bench.run.runner import fallbacks, run, unfinished
    from ded_bench.run.tasks import make_tasks

    chosen = _chosen(a)
    case = chosen.case
    results = Results(a.out or default_results(case))
    tasks = [
        task
        for name, settings in chosen_methods(a, search_folders(case, results.folder), a.time_limit)
        for task in make_tasks(case, chosen.instances, [name], a.regime or tuple(case.regimes), settings)
    ]
    for line in fallbacks(tasks, results.folder):
        say(line)
    todo = unfinished(tasks, results)

    def print_row(row: Row) -> None:
        if a.instance:
            _print_row(results, row)

    waiting = {task.key for task in todo}
    rows = finished = [results.rows[task.key] for task in tasks if task.key not in waiting]
    for row in finished:
        print_row(row)
    if todo:
        check_writable(results.path)
    there = f", {len(finished)} there already" if finished else ""
    say(f"{counted(len(todo), 'row')} to solve{there}")
    if todo:  # else nothing is written: the folder may refuse that
        rows = run(case, tasks, results, a.workers or 1, chosen.version, print_row, a.scheduler)
    tell_solved(case, results, rows, sys.stderr if a.instance else sys.stdout)
    print(f"{counted(len(rows), 'row')} in {results.path} ({len(finished)} there already)", file=sys.stderr)
    unanswered = Status.INFEASIBLE, Status.TIME_LIMIT  # results, too
    return 1 if any(row.objective is None and row.status not in unanswered for row in rows) else 0


def _score(a: argparse.Namespace) -> int:
    if a.update and not a.results:
        raise InputError("--update", "", "is only for --results")
    if a.plant and (a.schedules or a.update):
        option = "--schedules" if a.schedules else "--update"
        raise InputError("--plant", a.plant, f"is not for {option}, whose rows are of the case's own plant")
    if a.results:
        for option in ("regime", "limit", "name", "out"):
            if getattr(a, option) is not None:
                raise InputError(f"--{option}", "", "is not for --results, whose rows are all judged")
        return _score_results(a)
    if not a.regime:
        raise InputError("--regime", "", "is needed to judge a schedule")
    return _score_folder(a) if a.schedules else _score_one(a)


def _score_one(a: argparse.Namespace) -> int:
    """One schedule file, for one instance."""
    if len(a.instance or ()) != 1 or len(a.regime) != 1:
        raise InputError("--schedule", str(a.schedule), "needs one --instance and one --regime")
    chosen, (regime,) = _chosen(a), a.regime
    case, (instance, _) = chosen.case, chosen.instances[0]
    case.check_regimes([regime])
    schedule = Schedule.read(a.schedule, case, instance.horizon_s)
    from ded_bench.plants.score import score

    try:
        verdict = score(case, instance, schedule, regime, plant_of(case, a.plant))
    except SimulationError as error:
        say(f"{a.schedule}: {error}")
        return 1
    facts = dataclasses.asdict(verdict)
    facts |= {name: getattr(verdict, name) for name in ("feasible", "feasible_strict")}
    if a.json:
        print(json.dumps({"instance": instance.id, "regime": regime} | facts))
    else:
        for name, value in facts.items():
            print(f"{name:20} {value}")
    return 0


def _score_results(a: argparse.Namespace) -> int:
    """The schedules kept in a results folder, against its rows."""
    results, case, instances = _rows_of(a)
    say(f"simulating the schedules of {counted(len(results.rows), 'row')} in {a.results}")
    tell = functools.partial(print, file=sys.stderr if a.json else sys.stdout, flush=True)
    if a.plant:
        return _validate(a, case, instances, results)
    if a.update:
        check_writable(results.path)
    from ded_bench.run.scoring import rescore

    rows, found = rescore(case, instances, results, a.workers, update=a.update, on_difference=tell)
    if a.json:
        for row in rows:
            _print_row(results, row)
    unknown = sum(row.instance not in instances for row in results.rows.values())
    parts = [
        f"{counted(len(rows), 'row')} {'scored anew' if a.update else 'checked'} in {results.path}",
        counted(len(found), "difference"),
        f"{counted(len(results.rows) - unknown - len(rows), 'row')} without a kept schedule",
        *([f"{unknown} of unknown instances"] if unknown else []),
    ]
    tell(", ".join(parts))
    return 0 if a.update or not found else 1


def _validate(a: argparse.Namespace, case: Case, instances: dict[str, Instance], results: Results) -> int:
    """The schedules kept in a results folder, on the plant of `--plant`."""
    from ded_bench.run.scoring import validate

    plant_of(case, a.plant)  # says what the case lacks
    rows = validate(case, instances, results, a.plant, a.workers)
    if a.json:
        for row in rows:
            print(json.dumps(dataclasses.asdict(row)), flush=True)
    bad = [row for row in rows if row.objective is None]
    own = [row for row in rows if results.rows[row.key[0]].feasible]
    print(
        f"{counted(len(rows), 'row')} in {results.paths.validated}, {len(bad)} without a score; "
        f"{sum(bool(row.feasible) for row in own)} of {len(own)} feasible rows are so on {a.plant}",
        file=sys.stderr if a.json else sys.stdout,
    )
    return 1 if bad else 0


def _reproduce(a: argparse.Namespace) -> int:
    """Rows of a results folder, solved again."""
    results, case, instances = _rows_of(a)
    say(f"solving up to {a.sample} rows of each method, settings, model and regime in {a.results} again")
    from ded_bench.analysis.compare import reproduce

    methods = [name.replace(":", ".") for name in a.method]  # as rows of own methods have it
    found = reproduce(case, instances, results, methods, a.sample, a.workers, say)
    print(found.replace({"model": {"": "-"}}).to_string(index=False, float_format="{:.1e}".format))
    count, differ = int(found["rows"].sum()), int(found["differ"].sum())
    print(f"{counted(count, 'row')} solved again, {differ} differ")
    return 1 if differ or not count else 0


def _referee(a: argparse.Namespace) -> int:
    """Kept schedules of a results folder through ANDES."""
    from ded_bench.analysis.referee import referee

    results, case, instances = _rows_of(a)
    methods = [name.replace(":", ".") for name in a.method]  # as rows of own methods have it
    rows = referee(case, instances, results, methods, a.limit, a.python, a.workers)
    verified = [row for row in rows if results.rows[row.key].feasible and not row.error]
    print(
        f"{counted(len(rows), 'row')} in {results.paths.referee}, {sum(bool(row.error) for row in rows)} "
        f"without an answer; {sum(bool(row.confirmed) for row in verified)} of {len(verified)} feasible rows "
        "are confirmed"
    )
    return 1 if any(row.error for row in rows) else 0


def _rows_of(a: argparse.Namespace) -> tuple[Results, Case, dict[str, Instance]]:
    """The rows of a results folder, their case, and its instances by id, wherever they come from."""
    from ded_bench.results.rows import Results

    results = Results(a.results)
    if not results.rows:
        raise InputError(results.path, "", "is missing or has no rows")
    if lost := set(getattr(a, "method", ())) - {row.method for row in results.rows.values()}:
        raise InputError("--method", min(lost), f"has no rows in {results.path}")
    if a.instance:
        chosen = _chosen(a)
        return results, chosen.case, {instance.id: instance for instance, _ in chosen.instances}
    named = {row.case for row in results.rows.values()} - {""}
    if not a.case and len(named) != 1:
        raise InputError(results.path, "case", f"rows of {len(named)} cases: choose one by --case")
    place = a.case or named.pop()
    drawn = [row.instance.rpartition("-v")[2] for row in results.rows.values() if row.split == "validation"]
    count = max((int(number) + 1 for number in drawn if number.isdecimal()), default=0)
    selections = [select_split(place, "validation", count, servable)] if count else []
    selections += [select_split(place, "all")] if len(drawn) < len(results.rows) or not count else []
    found = {instance.id: instance for chosen in selections for instance, _ in chosen.instances}
    return results, selections[0].case, found


def _score_folder(a: argparse.Namespace) -> int:
    from ded_bench.results.rows import Results
    from ded_bench.run.runner import submit

    if not a.name:
        raise InputError("--schedules", str(a.schedules), "needs a --name for the rows")
    chosen = _chosen(a)
    results = Results(a.out or default_results(chosen.case))
    rows, unused = submit(chosen, a.schedules, a.name, a.regime, results, a.workers)
    if unused:
        named = ", ".join(path.name for path in unused[:3])
        say(f"{counted(len(unused), 'file')} of other instances: {named}")
    if a.json:
        for row in rows:
            _print_row(results, row)
    from ded_bench.cli.outcome import tell_solved

    tell_solved(chosen.case, results, rows, sys.stderr if a.json else sys.stdout)
    print(f"{counted(len(rows), 'row')} in {results.path}", file=sys.stderr)
    return 1 if any(row.objective is None for row in rows) else 0


def _chosen(a: argparse.Namespace) -> Selection:
    """The instances of `--instance` or of `--split`; those not shipped are checked against the physics."""
    if a.instance and a.limit:
        raise InputError("--limit", str(a.limit), "is of a split, not of --instance")
    if not a.instance:
        chosen = select_split(a.case or DEFAULT_CASE, a.split, a.limit, servable)
    else:
        a.instance = [instance_file(name, a.case) for name in a.instance]
        chosen = select_files(a.instance, Case.load(a.case) if a.case else None)
    if not a.instance and SHIPPED_CASES in chosen.case.folder.parents:
        return chosen  # the tests check those that are shipped
    places = a.instance or [f"instance {instance.id}" for instance, _ in chosen.instances]
    for place, (instance, _) in zip(places, chosen.instances, strict=True):
        check_plausible(chosen.case, instance, place)
        plant_of(chosen.case).check_servable(instance, str(place))
        if a.instance:
            check_own_name(instance, place, chosen.case)
    return chosen


def _print_row(results: Results, row: Row) -> None:
    """One JSON object: the row, the archive of its schedule and the schedule's name there."""
    scheduled = row.status != Status.FAILED and results.has_schedule(row)
    place = str(results.archive(row).path) if scheduled else None
    fields = {"schedule": place, "schedule_member": row.member if scheduled else None}
    print(json.dumps(dataclasses.asdict(row) | fields), flush=True)
