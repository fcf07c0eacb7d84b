"""Commands that tell what results mean: bench, certify, compare, report, overview."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ded_bench.cli.arguments import (
    command,
    counted,
    declare,
    names,
    not_negative,
    positive,
    positive_number,
    say,
    share,
)
from ded_bench.files.errors import InputError
from ded_bench.methods.registry import get_method, registered
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import select_split, validation_instances
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.results.folder import ResultsFolder, default_results, reference_run, search_folders
from ded_bench.solvers.status import Status


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "bench", "time methods in turns, alone on the machine, one thread")
    declare(p, "--case", "--results")
    p.add_argument("--method", type=names, metavar="M[,M]", help="default: all registered in the results")
    p.add_argument("--instances", type=positive, default=10, help="how many test instances to time")
    p.add_argument("--repeats", type=positive, help="rounds; default: by the method's speed")
    p.add_argument("--force", action="store_true", help="time again what the table holds")
    p.add_argument("--out", type=Path, help="table of the run; default: timing.csv in the results folder")
    p.set_defaults(run=_bench)

    p = command(commands, "certify", "certify a policy on fresh instances")
    p.add_argument("--method", default="ded-dpc", help="a policy")
    declare(p, "--regime", "--set", "--model", "--policy", "--case", "--seed", "--workers", "--results")
    p.add_argument("--count", type=positive, default=10_000, metavar="M", help="how many fresh instances")
    p.add_argument("--gap", type=positive_number, default=1.0, metavar="PERCENT", help="over ded-ko-knots")
    p.add_argument("--tolerance", type=positive_number, default=1e-6, metavar="HZ", help="of the frequency")
    p.add_argument("--delta", type=share, default=0.01, help="1 - confidence")
    p.set_defaults(run=_certify)

    p = command(commands, "compare", "what changed between two results folders")
    p.add_argument("a", type=Path, metavar="A", help="the results folder that sets the standard")
    p.add_argument("b", type=Path, metavar="B", help="another one")
    p.add_argument("--tolerance", type=not_negative, default=1e-6, metavar="X", help="objective, relative")
    p.add_argument("--tolerance-hz", type=not_negative, default=1e-6, metavar="HZ", help="violations")
    p.add_argument("--tolerance-pu", type=not_negative, default=1e-8, metavar="PU", help="violations")
    p.add_argument("--common", action="store_true", help="rows that only one has are no difference")
    p.add_argument("--json", action="store_true", help="one JSON object instead of lines")
    p.set_defaults(run=_compare)

    p = command(commands, "report", "write tables V and VI, figures, report.md and report.html")
    declare(p, "--case", "--results")
    p.add_argument("--workers", type=positive, help="no effect: rows are scored when solved")
    p.set_defaults(run=_report)

    p = command(commands, "overview", "one page over several grids: gaps, violations, time and memory")
    p.add_argument(
        "--results",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="one case each; default: each shipped case's own results, else its reference run",
    )
    p.add_argument("--case", nargs="+", default=(), metavar="DIR", help="folders of cases that do not ship")
    p.add_argument("--out", type=Path, default=Path("results/overview"), help="default: results/overview")
    p.set_defaults(run=_overview)


def _bench(a: argparse.Namespace) -> int:
    from ded_bench.analysis.summary import title
    from ded_bench.results.rows import Results
    from ded_bench.results.timing import model_name, timing_summary
    from ded_bench.run.bench import bench, choose_sample, not_timed, runs_of

    chosen = select_split(a.case)
    case = chosen.case
    results = Results(a.results or default_results(case))
    methods = {m.name: m for m in map(get_method, a.method)} if a.method else registered()
    own = [row for row in results.rows.values() if row.case in ("", case.id)]
    known = {row.method for row in own}
    lacking = "it has no registered name: give it as --method module:function"
    skipped = {name: lacking for name in known if not a.method and name not in methods}
    skipped |= {name: "the results hold no rows of it" for name in methods if a.method and name not in known}
    for key in (row.key for row in own):
        if key.method in methods and (reason := not_timed(key, methods[key.method])):
            skipped[title(key.method, key.settings, model_name(key.model))] = reason
    for name, reason in sorted(skipped.items()):
        say(f"{name}: not timed, since {reason}")
    jobs = runs_of(own, Settings(search=search_folders(case, results.folder)), methods)
    if not jobs:
        raise InputError(results.folder, "", "holds no rows of these methods: run `ded-bench solve` first")
    timed = ", ".join(sorted({job.method for job in jobs}))
    say(f"timing on {counted(min(a.instances, len(chosen.instances)), 'instance')}: {timed}")
    rows = bench(
        case,
        choose_sample([instance for instance, _ in chosen.instances], a.instances),
        jobs,
        a.out or ResultsFolder(results.folder).timing,
        warm_up=validation_instances(case, 1, servable=servable)[0],
        rounds=a.repeats,
        force=a.force,
        problems_version=chosen.version,
    )
    for row in timing_summary(rows).to_dict("records"):
        timed = row["time_s"] == row["time_s"]
        said = f"{row['time_s']:.6f} s, {row['repeats']} rounds" if timed else row["error"]
        name = f"{row['method']:<16} {row['settings']:<12} {row['model']:<12} {row['regime']:<4}"
        print(f"{name} {said}", flush=True)
    return 1 if any(row.status == Status.FAILED for row in rows) else 0


def _certify(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    regimes = a.regime or tuple(case.regimes)
    case.check_regimes(regimes)
    folder = a.results or default_results(case)
    settings = Settings(a.set, a.model, a.policy, search=search_folders(case, folder))
    from ded_bench.analysis.certificate import Candidate, Criteria, certify, save_certificate

    candidates = [Candidate(get_method(a.method).name, regime, settings) for regime in regimes]
    for candidate in candidates:
        candidate.facts(case)  # says what is missing
    say(f"{a.method} and ded-ko-knots on {counted(a.count, 'fresh instance')}, {' and '.join(regimes)}")
    criteria = Criteria(gap_percent=a.gap, tolerance_hz=a.tolerance, delta=a.delta)
    for candidate in candidates:
        certificate = certify(
            case, candidate, folder, criteria, count=a.count, seed=a.seed, workers=a.workers
        )
        save_certificate(folder, certificate)
        print(certificate.sentence)
    return 0


def _compare(a: argparse.Namespace) -> int:
    if all(ResultsFolder(folder).results.is_file() for folder in (a.a, a.b)):
        say(f"comparing {a.a} with {a.b}")
    from ded_bench.analysis.compare import compare, limits, to_json, to_text

    found = compare(a.a, a.b, limits(a.tolerance, a.tolerance_hz, a.tolerance_pu), common_only=a.common)
    print(to_json(found) if a.json else to_text(found), end="\n" if a.json else "")
    return 0 if found.same else 1


def _report(a: argparse.Namespace) -> int:
    from ded_bench.results.rows import OBJECTIVES, Results, objectives_of

    case = Case.load(a.case)
    folder = a.results or default_results(case)
    if rows := sum(row.case in (case.id, "") for row in Results(folder).rows.values()):
        say(f"tables and figures of {counted(rows, 'row')} in {folder}")
    from ded_bench.report.report import write_report

    written = write_report(case, folder, print)
    OBJECTIVES.write(ResultsFolder(folder).objectives, objectives_of(Results(folder).rows.values()))
    print(f"wrote {len(written)} files; read {folder / 'report.html'} or {folder / 'report.md'}")
    return 0


def _overview(a: argparse.Namespace) -> int:
    folders: list[Path] = a.results or []
    for path in [] if folders else sorted(SHIPPED_CASES.glob("*/case.json")):
        case = Case.load(path)  # its results below the working directory, else its reference run, if any
        choices = default_results(case), reference_run(case)
        folders += [folder for folder in choices if ResultsFolder(folder).results.is_file()][:1]
    if not folders:
        raise InputError("results", "", "holds no results of a shipped case; run `ded-bench solve` first")
    if all(ResultsFolder(folder).results.is_file() for folder in folders):
        say(f"tables and figures over {', '.join(map(str, folders))}")
    from ded_bench.report.overview import write_overview

    written = write_overview(folders, a.out, tuple(map(Case.load, a.case)))
    print(f"wrote {len(written)} files; read {a.out / 'overview.html'} or {a.out / 'overview.md'}")
    return 0
