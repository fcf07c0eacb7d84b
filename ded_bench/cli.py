"""The `ded-bench` commands: parse, call, print; exit code 0, 1 (work failed) or 2 (bad input)."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.arguments import DEFAULT_CASE, parser
from ded_bench.bench.pool import Workers, WorkersLostError
from ded_bench.koopman.store import default_results, search_folders
from ded_bench.methods.solution import Settings
from ded_bench.problem.benchmark import Selection, problem_folder, select_files, select_split
from ded_bench.problem.case import Case
from ded_bench.problem.errors import InputError
from ded_bench.problem.sampling import write_benchmark
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.strict import write_atomically

if TYPE_CHECKING:
    from ded_bench.bench.results import Results, Row


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        return COMMANDS[arguments.command](arguments)
    except InputError as error:
        print(f"ded-bench: {error}", file=sys.stderr)
        return 2
    except WorkersLostError as error:
        print(f"ded-bench: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print("ded-bench: interrupted; what was finished is saved, run again to continue", file=sys.stderr)
        return 130


def _instances(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    folder = a.out or problem_folder(a.case, case)
    manifest = write_benchmark(case, a.count, a.seed, folder)
    print(f"{a.count} instances of {case.id} (seed {a.seed}) in {folder}, version {manifest.version}")
    return 0


def _solve(a: argparse.Namespace) -> int:
    from ded_bench.bench.results import Results
    from ded_bench.bench.run import make_tasks, run
    from ded_bench.methods import get_method
    from ded_bench.methods.solution import Status

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


def _train_ko(a: argparse.Namespace) -> int:
    from ded_bench.koopman.fit import held_out, identify, rollout_table
    from ded_bench.koopman.paper import identify_paper
    from ded_bench.koopman.physics import linear_model
    from ded_bench.koopman.store import model_file

    case = Case.load(a.case)
    out = a.out or model_file(a.results or default_results(case), a.kind)
    if out.exists() and not a.force:
        print(f"{out} is there already (--force makes it anew)")
        return 0
    model = (identify if a.kind == "koopman" else identify_paper)(case, a.seed)
    model.save(out)
    table = rollout_table(case, [linear_model(case), model], held_out(case, a.seed))
    write_atomically(out.with_suffix(".errors.csv"), table.to_csv(index=False))
    print(table.to_string(index=False, float_format="{:.3g}".format))
    print(f"wrote {out}")
    return 0


def _train_dpc(a: argparse.Namespace) -> int:
    import torch

    from ded_bench.koopman.store import find_model
    from ded_bench.methods import get_method
    from ded_bench.methods.dpc import ded_dpc_train, train
    from ded_bench.methods.dpc.store import policy_file

    trainers: dict[str, Any] = {"ded-dpc-paper": train.train, "ded-dpc": ded_dpc_train.train}
    if a.method not in trainers:
        known = ", ".join(trainers)
        raise InputError("--method", a.method, f"is not trained by this command (known: {known})")
    choices = get_method(a.method).settings
    if a.settings not in choices:
        raise InputError("--settings", a.settings, f"unknown (known: {', '.join(choices)})")
    case = Case.load(a.case)
    case.check_regimes([a.regime])
    results = a.results or default_results(case)
    out = a.out or policy_file(results, a.method, a.regime, a.model, a.settings)
    if out.exists() and not (a.force or a.resume):
        print(f"{out} is there already (--force trains anew)")
        return 0
    model = find_model(case, a.model, search_folders(case, results))
    instances = [instance for instance, _ in select_split(a.case, "train", a.limit).instances]
    torch.set_num_threads(1)  # these networks gain nothing from more, and results then repeat anywhere
    options = choices[a.settings] | {"seed": a.seed, "device": a.device, "resume": a.resume}
    options |= {"epochs": a.epochs} if a.epochs else {}
    policy = trainers[a.method](case, a.regime, instances, model, out, seconds=a.seconds, **options)
    facts = policy.training
    print(
        f"wrote {out}: {facts['epochs']} epochs in {facts['seconds']:.0f} s, "
        f"held-out loss {facts['held_out_loss']:.6g}"
    )
    return 0


def _bench(a: argparse.Namespace) -> int:
    from ded_bench.bench.results import Results
    from ded_bench.bench.timing import bench_folder, choose_sample, runs_of
    from ded_bench.methods import get_method, registered

    chosen = select_split(a.case)
    case = chosen.case
    folder = a.results or default_results(case)
    rows = Results(folder).rows
    methods = {m.name: m for m in map(get_method, a.method)} if a.method else registered()
    runs = runs_of(rows, Settings(search=search_folders(case, folder)), methods)
    if not a.method:
        for name in sorted({key.method for key in rows} - set(methods)):
            print(f"ded-bench: {name}: not timed, since no method has this name", file=sys.stderr)
    if not runs:
        raise InputError(folder, "", "holds no rows of these methods to time; run `ded-bench solve` first")
    failures = 0
    for method, regimes, settings in runs:
        for row in bench_folder(
            folder,
            case,
            choose_sample([instance for instance, _ in chosen.instances], a.instances),
            [method],
            regimes,
            settings,
            repeats=a.repeats,
            force=a.force,
            problems_version=chosen.version,
        ):
            median = f"{row.solve_s:.6f} s" if row.solve_s is not None else row.error
            print(f"{row.method:<16} {row.settings:<12} {row.regime:<4} {median}", flush=True)
            failures += row.solve_s is None
    return 1 if failures else 0


def _certify(a: argparse.Namespace) -> int:
    from ded_bench.bench.certificate import certify, rows_file, save_certificate

    case = Case.load(a.case)
    case.check_regimes(a.regime)
    folder = a.results or default_results(case)
    settings = Settings(a.settings, a.model, a.policy, search=search_folders(case, folder))
    for regime in a.regime:
        certificate = certify(
            case,
            a.method,
            regime,
            settings,
            rows_file(folder, a.method, regime, settings),
            count=a.count,
            seed=a.seed,
            gap_percent=a.gap,
            tolerance_hz=a.tolerance,
            delta=a.delta,
            workers=a.workers,
        )
        save_certificate(folder, certificate)
        print(certificate.sentence)
    return 0


def _rollouts(a: argparse.Namespace) -> int:
    from ded_bench.bench.results import Results
    from ded_bench.bench.studies import rollout_errors
    from ded_bench.koopman.store import MODELS, find_model

    chosen = select_split(a.case)
    case = chosen.case
    folder = a.results or default_results(case)
    models = []
    for name in MODELS:
        try:
            models.append(find_model(case, name, search_folders(case, folder)))
        except InputError as error:
            print(f"ded-bench: left out: {error}", file=sys.stderr)
    instances = [instance for instance, _ in chosen.instances]
    table = rollout_errors(case, Results(folder), instances, models)
    print(table.to_string(index=False, float_format="{:.3g}".format))
    return 0


def _report(a: argparse.Namespace) -> int:
    with Workers(a.workers) if a.workers > 1 else nullcontext() as pool:
        if pool:
            pool.warm("ded_bench.bench.gallery")  # while this process imports it, too
        from ded_bench.bench.report import write_report

        case = Case.load(a.case)
        folder = a.results or default_results(case)
        written = write_report(case, folder, problem_folder(a.case, case), pool)
    print(f"wrote {len(written)} files; read {folder / 'report.html'} or {folder / 'report.md'}")
    return 0


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
    from ded_bench.bench.results import Results
    from ded_bench.bench.submit import submit

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


def _compare(a: argparse.Namespace) -> int:
    from ded_bench.bench.compare import Tolerance, compare, to_json, to_text

    limits = Tolerance(a.tolerance, a.tolerance_hz, a.tolerance_pu)
    found = compare(a.a, a.b, limits, common_only=a.common)
    print(to_json(found) if a.json else to_text(found), end="\n" if a.json else "")
    return 0 if found.same else 1


def _chosen(a: argparse.Namespace) -> Selection:
    """The instances of `--instance`, checked against the physics, or of `--split`."""
    from ded_bench.truth.swing import check_servable

    if not a.instance:
        return select_split(a.case or DEFAULT_CASE, a.split, a.limit)
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


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "instances": _instances,
    "train-ko": _train_ko,
    "solve": _solve,
    "train-dpc": _train_dpc,
    "score": _score,
    "bench": _bench,
    "certify": _certify,
    "compare": _compare,
    "rollouts": _rollouts,
    "report": _report,
}
