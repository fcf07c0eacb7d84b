"""The `ded-bench` commands: parse, call, print; exit code 0, 1 (work failed) or 2 (bad input)."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from ded_bench.koopman.store import TRAINED
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import REPOSITORY, SHIPPED_CASES, Case
from ded_bench.problem.errors import InputError
from ded_bench.problem.instance import Instance, load_instances
from ded_bench.problem.sampling import load_manifest, load_split, write_benchmark
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.strict import write_atomically

DEFAULT_CASE = "9bus"
REFERENCE = "{case}-reference"


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    arguments = _parser().parse_args(argv)
    try:
        code: int = arguments.command(arguments)
        return code
    except InputError as error:
        print(f"ded-bench: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print("ded-bench: interrupted; what was finished is saved, run again to continue", file=sys.stderr)
        return 130


def _instances(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    folder = a.out or _problem_folder(a.case, case)
    manifest = write_benchmark(case, a.count, a.seed, folder)
    print(f"{a.count} instances of {case.id} (seed {a.seed}) in {folder}, version {manifest.version}")
    return 0


def _solve(a: argparse.Namespace) -> int:
    from ded_bench.bench.results import Results
    from ded_bench.bench.run import make_tasks, run
    from ded_bench.methods import get_method
    from ded_bench.methods.solution import Status

    for name in a.method:
        get_method(name)
    case, instances, version = _chosen_instances(a)
    results = Results(a.out or _default_results(case))
    settings = _settings(a, case, results.folder)
    tasks = make_tasks(case, instances, a.method, a.regime, settings)

    def print_row(row: object) -> None:
        if a.instance:
            path = results.schedule_path(row.key)  # type: ignore[attr-defined]
            fields = dataclasses.asdict(row)  # type: ignore[call-overload]
            fields["schedule"] = str(path) if path.is_file() and fields["status"] != "Failed" else None
            print(json.dumps(fields), flush=True)

    finished = [task.key for task in tasks if results.has(task.key, task.fingerprint)]
    for key in finished:
        print_row(results.rows[key])
    rows = run(case, tasks, results, a.workers, version, print_row)
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
    out = a.out or model_file(a.results or _default_results(case), a.kind)
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
    results = a.results or _default_results(case)
    out = a.out or policy_file(results, a.method, a.regime, a.model, a.settings)
    if out.exists() and not (a.force or a.resume):
        print(f"{out} is there already (--force trains anew)")
        return 0
    model = find_model(case, a.model, search_folders(case, results))
    folder = _problem_folder(a.case, case)
    names = load_split(folder).train[: a.limit]
    instances, case = load_instances([folder / "instances" / f"{name}.json" for name in names], case)
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

    case = Case.load(a.case)
    folder = a.results or _default_results(case)
    problems = _problem_folder(a.case, case)
    names = sorted(load_split(problems).test)
    instances, case = load_instances([problems / "instances" / f"{name}.json" for name in names], case)
    manifest = load_manifest(problems)
    runs = runs_of(Results(folder).rows, Settings(search=search_folders(case, folder)))
    runs = [run for run in runs if not a.method or run[0] in a.method]
    if not runs:
        raise InputError(folder, "", "holds no rows of these methods to time; run `ded-bench solve` first")
    failures = 0
    for method, regimes, settings in runs:
        for row in bench_folder(
            folder,
            case,
            choose_sample(instances, a.instances),
            [method],
            regimes,
            settings,
            repeats=a.repeats,
            force=a.force,
            problems_version=manifest.version if manifest else "",
        ):
            median = f"{row.solve_s:.6f} s" if row.solve_s is not None else row.error
            print(f"{row.method:<16} {row.settings:<12} {row.regime:<4} {median}", flush=True)
            failures += row.solve_s is None
    return 1 if failures else 0


def _report(a: argparse.Namespace) -> int:
    from ded_bench.bench.report import write_report

    case = Case.load(a.case)
    folder = a.results or _default_results(case)
    written = write_report(case, folder, _problem_folder(a.case, case))
    print(f"wrote {len(written)} files; read {folder / 'report.html'} or {folder / 'report.md'}")
    return 0


def _score(a: argparse.Namespace) -> int:
    from ded_bench.truth.score import score
    from ded_bench.truth.simulate import SimulationError

    instance, case = _load_one(a.instance, a.case)
    case.check_regimes([a.regime])
    schedule = Schedule.read(a.schedule, case, instance.horizon_s)
    try:
        verdict = score(case, instance, schedule, a.regime)
    except SimulationError as error:
        print(f"ded-bench: {a.schedule}: {error}", file=sys.stderr)
        return 1
    facts = dataclasses.asdict(verdict) | {
        "feasible": verdict.feasible,
        "feasible_strict": verdict.feasible_strict,
    }
    if a.json:
        print(json.dumps({"instance": instance.id, "regime": a.regime} | facts))
    else:
        for name, value in facts.items():
            print(f"{name:20} {value}")
    return 0


def _chosen_instances(a: argparse.Namespace) -> tuple[Case, list[tuple[Instance, str]], str]:
    """Case, instances with their split, and the version of the problem files."""
    from ded_bench.truth.swing import check_servable

    case = Case.load(a.case) if a.case else None
    if a.instance:
        instances, case = load_instances(a.instance, case)
        for path, instance in zip(a.instance, instances, strict=True):
            check_servable(case, instance, str(path))
        folder = Path(a.instance[0]).resolve().parent.parent
    else:
        case = case or Case.load(DEFAULT_CASE)
        folder = _problem_folder(a.case or DEFAULT_CASE, case)
        split = load_split(folder)
        names = {"train": split.train, "test": split.test, "all": split.train + split.test}[a.split]
        names = tuple(sorted(names))[: a.limit]
        instances, case = load_instances([folder / "instances" / f"{name}.json" for name in names], case)
    manifest = load_manifest(folder)
    known = _split_of(folder, instances)
    return case, list(zip(instances, known, strict=True)), manifest.version if manifest else ""


def _split_of(folder: Path, instances: Sequence[Instance]) -> list[str]:
    """`train` or `test` for the benchmark's own instances, `none` for everything else."""
    if not (folder / "split.json").is_file():
        return ["none"] * len(instances)
    split = load_split(folder)
    return ["train" if i.id in split.train else "test" if i.id in split.test else "none" for i in instances]


def _load_one(path: Path, case_name: str | None) -> tuple[Instance, Case]:
    from ded_bench.truth.swing import check_servable

    instance, case = Instance.load_file(path, Case.load(case_name) if case_name else None)
    check_servable(case, instance, str(path))
    return instance, case


def _settings(a: argparse.Namespace, case: Case, out: Path) -> Settings:
    return Settings(
        name=a.settings,
        model=a.model,
        policy=a.policy,
        time_limit_s=a.time_limit,
        search=search_folders(case, out),
    )


def search_folders(case: Case, out: Path) -> tuple[Path, ...]:
    """Where trained models and policies are looked for: `out`, default results, reference run."""
    reference = REPOSITORY / "results" / REFERENCE.format(case=case.id)
    return (out, _default_results(case), reference)


def _default_results(case: Case) -> Path:
    return Path("results") / case.id


def _problem_folder(name: str | Path, case: Case) -> Path:
    path = Path(name)
    if path.is_dir():
        return path
    return path.parent if path.is_file() else SHIPPED_CASES / case.id


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="ded-bench",
        description="Benchmark suite for the dynamics-aware economic dispatch (DED) problem.",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    p = commands.add_parser("instances", help="draw the benchmark's instances (paper, Table III)")
    p.add_argument("--count", type=_positive, default=500)
    p.add_argument("--seed", type=_natural, default=2022)
    p.add_argument("--case", default=DEFAULT_CASE, help="name of a shipped case, or a folder")
    p.add_argument("--out", type=Path, help="default: the case's own folder")
    p.set_defaults(command=_instances)

    p = commands.add_parser("train-ko", help="identify the Koopman model from simulated trajectories")
    p.add_argument("--kind", choices=TRAINED, default=TRAINED[0], help="ours, or the paper's recipe")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--seed", type=_natural, default=0)
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="model file; default: in the results folder")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.set_defaults(command=_train_ko)

    p = commands.add_parser("solve", help="solve instances with methods, score, one row each")
    p.add_argument("--method", type=_names, required=True, metavar="M[,M]")
    p.add_argument("--regime", type=_names, required=True, metavar="R[,R]")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=("test", "train", "all"), default="test")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE")
    p.add_argument("--limit", type=_positive, help="only the first so many of the split")
    p.add_argument("--case", help="name of a shipped case, or a folder")
    p.add_argument("--settings", default="default", help="slug of the method's settings")
    p.add_argument("--model", default="koopman", help="koopman, koopman-paper, linear, or a file")
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")
    p.add_argument("--workers", type=_positive, default=1)
    p.add_argument("--time-limit", type=_seconds, metavar="S", help="per solve")
    p.add_argument("--out", type=Path, help="results folder")
    p.set_defaults(command=_solve)

    p = commands.add_parser("train-dpc", help="train a policy on the training instances")
    p.add_argument("--method", default="ded-dpc", help="ded-dpc or ded-dpc-paper")
    p.add_argument("--settings", default="default", help="slug of the training settings")
    p.add_argument("--regime", required=True)
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--model", default="koopman", help="koopman, koopman-paper, linear, or a file")
    p.add_argument("--seed", type=_natural, default=0)
    budget = p.add_mutually_exclusive_group()
    budget.add_argument("--seconds", type=_seconds, metavar="S", help="train for so long")
    budget.add_argument("--epochs", type=_positive, metavar="N")
    p.add_argument("--limit", type=_positive, help="only the first so many training instances")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="policy file; default: in the results folder")
    p.set_defaults(command=_train_dpc)

    p = commands.add_parser("score", help="simulate a schedule CSV on the true system and judge it")
    p.add_argument("--instance", type=Path, required=True, metavar="FILE")
    p.add_argument("--schedule", type=Path, required=True, metavar="CSV")
    p.add_argument("--regime", required=True)
    p.add_argument("--case")
    p.add_argument("--json", action="store_true", help="one JSON object instead of lines")
    p.set_defaults(command=_score)
    p = commands.add_parser("bench", help="time methods, each alone on the machine, one thread")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--method", type=_names, metavar="M[,M]", help="default: all in the results")
    p.add_argument("--instances", type=_positive, default=10, help="how many test instances to time")
    p.add_argument("--repeats", type=_positive, help="solves of each; default: by the method's speed")
    p.add_argument("--force", action="store_true", help="time again what timing.csv holds")
    p.add_argument("--results", type=Path, help="results folder")
    p.set_defaults(command=_bench)

    p = commands.add_parser("report", help="write tables V and VI, figures, report.md and report.html")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--results", type=Path, help="results folder")
    p.set_defaults(command=_report)
    return parser


def _names(text: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names:
        raise argparse.ArgumentTypeError("names nothing")
    return tuple(dict.fromkeys(names))


def _natural(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


def _positive(text: str) -> int:
    if (value := _natural(text)) < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
    return value
