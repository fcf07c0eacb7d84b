"""Commands that list methods, and make, list and check problems."""

from __future__ import annotations

import argparse
import re
import tempfile
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import command, counted, declare, natural, positive, say
from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically, write_record
from ded_bench.methods.options import described
from ded_bench.methods.registry import get_method, registered
from ded_bench.plants.plant import SimulationError, servable
from ded_bench.problem.benchmark import (
    Manifest,
    copy_case,
    load_manifest,
    load_split,
    write_benchmark,
    write_scenarios,
)
from ded_bench.problem.case import SHIPPED_CASES, Case, case_file
from ded_bench.problem.quantities import NAME, check_whole_steps
from ded_bench.problem.sampling import DURATION_S, SCENARIOS

if TYPE_CHECKING:
    from ded_bench.analysis.inspect_case import CaseCheck

COUNT, SEED = 500, 2022


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "cases", "list the shipped cases, or check a case of your own")
    p.add_argument("case", nargs="?", help="a case to check: folder, case.json, or name of a shipped one")
    p.add_argument("--count", type=positive, default=50, help="instances to draw and simulate")
    p.set_defaults(run=_cases)

    p = command(commands, "path", "print the folder of a shipped case")
    p.add_argument("case", help="its name")
    p.set_defaults(run=_path)

    p = command(commands, "import", "make a case of a MATPOWER grid")
    p.add_argument("file", type=Path, help="MATPOWER case (.m); parsed, never executed")
    p.add_argument(
        "--dynamics", type=Path, required=True, metavar="FILE", help="bus,h,xd1 as CSV, or PSS/E dyr"
    )
    p.add_argument("--like", help="case with the ranges, regimes and ramp limit; default: of similar size")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="the case's folder, and its name")
    p.set_defaults(run=_import)

    p = command(commands, "methods", "list methods, their options and defaults")
    p.add_argument("name", nargs="?", metavar="NAME", help="only this one; default: all")
    p.set_defaults(run=_methods)

    p = command(commands, "instances", "draw the benchmark's instances (paper, Table III)")
    same = "default: as in the split that the case has, else"
    declare(p, "--case")
    p.add_argument("--count", type=positive, help=f"how many to draw ({same} {COUNT})")
    p.add_argument("--test", type=positive, help=f"how many are for testing ({same} a fifth)")
    p.add_argument("--seed", type=natural, help=f"master seed ({same} {SEED})")
    p.add_argument("--out", type=Path, help="default: the case's own folder")
    p.add_argument("--force", action="store_true", help="replace other instances of a versioned case")
    p.set_defaults(run=_instances)

    p = command(commands, "scenarios", "draw minutes of operation for the closed loop")
    p.add_argument("--count", type=positive, default=SCENARIOS, help=f"how many of {DURATION_S:g} s to draw")
    hours = "how many of an hour, in which loads drift, too (default: as many as there are)"
    p.add_argument("--hours", type=natural, help=hours)
    declare(p, "--case", "--seed")
    p.add_argument("--out", type=Path, help="default: scenarios in the case's own folder")
    p.add_argument("--force", action="store_true", help="replace other scenarios of a versioned case")
    p.set_defaults(run=_scenarios)


def _instances(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    home = case.folder
    split = load_split(home) if (home / "split.json").is_file() else None
    test, seed = a.test, SEED if split is None else split.seed
    there = 0 if split is None else len(split.train) + len(split.test)
    count = a.count or there or COUNT
    if test is None and split is not None and count == there:
        test = len(split.test)
    seed = seed if a.seed is None else a.seed
    folder = a.out or home

    def draw(folder: Path) -> Manifest:
        return write_benchmark(case, count, seed, folder, test, servable, case_file(a.case))

    manifest = draw(folder) if a.force else _unless_changed(folder, draw)
    print(f"{counted(count, 'instance')} of {case.id} (seed {seed}) in {folder}, version {manifest.version}")
    if manifest.redraws:
        print(f"{manifest.redraws} loads or instances were drawn again: wrong sign, or not servable")
    return 0


def _unless_changed(folder: Path, draw: Callable[[Path], Manifest]) -> Manifest:
    """Draw into a folder that has no version yet; one that has is made whole again, but not changed.

    Raises:
        InputError: what is drawn is not what the folder's version stands for.
    """
    present = load_manifest(folder)
    if present is None:
        return draw(folder)
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as name:
        place = Path(name)
        if (folder / "case.json").is_file():
            copy_case(folder / "case.json", place)  # its bytes are part of the version
        drawn = draw(place)
        if drawn.version != present.version:
            problem = (
                f"holds version {present.version}, and this is {drawn.version}: name another folder by "
                "--out, or replace what is there by --force"
            )
            raise InputError(folder, "", problem)
        for file in drawn.files:
            content = (place / file).read_bytes()
            if not (folder / file).is_file() or (folder / file).read_bytes() != content:
                write_atomically(folder / file, content)
    return drawn


def _path(a: argparse.Namespace) -> int:
    print(Case.load(a.case).folder.resolve())
    return 0


def _import(a: argparse.Namespace) -> int:
    from ded_bench.analysis.matpower_case import imported

    path, name = a.out / "case.json", a.out.resolve().name
    if path.exists():
        raise InputError(path, "", "is there already")
    if not re.fullmatch(NAME, name):
        problem = f"{name!r} cannot name a case: letters, digits, and after one of these also _ . -"
        raise InputError("--out", str(a.out), problem)
    try:
        case = imported(a.file, a.dynamics, name, Case.load(a.like) if a.like else None)
    except SimulationError as error:
        say(f"{a.file}: the lossless grid has no equilibrium: {error}")
        return 1
    write_record(case, path)
    assert isinstance(case.source, dict)
    size = f"{len(case.machines)} generators, slack {case.slack}, {case.n_bus} buses"
    print(f"case {case.id} in {a.out}: {size}")
    print(f"{case.source['conversion'].partition('; ')[2]}; knots {case.knots}")
    print(f"next: ded-bench cases {a.out}")
    return 0


def _methods(a: argparse.Namespace) -> int:
    """A line for a method, and one for each of its options; what cannot be imported says why."""
    for method in [get_method(a.name)] if a.name else registered().values():
        try:
            options = described(method.options)
        except InputError as error:
            print(f"{method.name:<16} cannot be used: {error}")
            continue
        print(f"{method.name:<16} {method.title}")
        for name, default, text in options:
            print(textwrap.fill(f"  {f'{name}={default}':<20} {text}", 110, subsequent_indent=" " * 23))
    return 0


def _list() -> int:
    import pandas as pd

    rows = []
    for path in SHIPPED_CASES.glob("*/case.json"):
        case, split, manifest = Case.load(path), load_split(path.parent), load_manifest(path.parent)
        sizes = case.n_bus, len(case.generators), len(case.loads), f"{len(split.train)}+{len(split.test)}"
        rows.append((case.id, *sizes, manifest.version if manifest else ""))
    heads = ["case", "buses", "generators", "loads", "instances", "version"]
    print(pd.DataFrame(rows, columns=heads).sort_values("buses").to_string(index=False))
    print("\nGenerators without the slack; instances for training + testing.")
    return 0


def _cases(a: argparse.Namespace) -> int:
    if a.case is None:
        return _list()
    from ded_bench.analysis.inspect_case import check_case, implausible

    case = Case.load(a.case)
    sizes = f"{case.n_bus} buses, {len(case.generators)} generators, {len(case.loads)} loads"
    print(f"case {case.id}: {sizes}", flush=True)
    say(f"drawing and simulating {counted(a.count, 'instance')}")
    try:
        found = check_case(case, a.count)
    except SimulationError as error:
        say(f"case {case.id}: {error}")
        return 1
    _print_check(case, found)
    for warning in implausible(case, found):
        print(f"warning      {warning}")
    if not found.served:
        say(f"case {case.id}: no instance can be served")
        return 1
    return 0


def _print_check(case: Case, found: CaseCheck) -> None:
    import numpy as np

    nominal, slack = found.nominal, found.nominal.p_slack
    angle = f"largest angle across a line {nominal.angle_deg:.1f} degrees"
    print(f"power flow   {'island' if slack is None else f'slack {slack:.4g} pu'}, {angle}")
    knots = "" if found.knots is None else f", suggested {found.knots}"
    print(f"modes        {len(found.frequency_hz)}; knots {case.n_knots}{knots}")
    print("             Hz        damping %")
    for frequency, damping in zip(found.frequency_hz, found.damping, strict=True):
        print(f"             {frequency:<8.3f}  {100 * damping:.1f}")
    again = f"{found.redrawn_loads} loads drawn again"
    print(f"draws        {found.served} of {found.drawn} servable at once; {again}")
    if not found.served:
        return
    print("static dispatch: largest of an instance, Hz")
    print("                       " + "".join(f"{kind:<10}" for kind in found.peak_hz))
    for percent in (0, 10, 25, 50, 75, 90, 100):
        peaks = [np.quantile(of, percent / 100, method="higher") for of in found.peak_hz.values()]
        print(f"             {percent:>3} %     " + "".join(f"{peak:<10.4g}" for peak in peaks).rstrip())
    print("static dispatch violates")
    for regime, limits in case.regimes.items():
        bounds = ", ".join(f"{name} {value:g}" for name, value in limits)
        print(f"             {regime}: {100 * found.violating[regime]:.0f} % of the instances ({bounds})")


def _scenarios(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    try:
        check_whole_steps(f"a scenario's duration of {DURATION_S:g} s", DURATION_S, case.sampling.dt_s)
    except ValueError as error:
        raise InputError(a.case, "sampling", str(error)) from None
    folder = a.out or case.folder / "scenarios"
    hours = len(list(folder.glob(f"{case.id}-h[0-9]*.json"))) if a.hours is None else a.hours

    def draw(folder: Path) -> Manifest:
        return write_scenarios(case, a.count, a.seed, folder, servable, hours=hours)

    manifest = draw(folder) if a.force else _unless_changed(folder, draw)
    drawn = counted(a.count + hours, "scenario")
    print(f"{drawn} of {case.id} (seed {a.seed}) in {folder}, version {manifest.version}")
    return 0
