"""Commands that make problems."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import (
    DEFAULT_CASE,
    command,
    natural,
    positive,
)
from ded_bench.problem.benchmark import problem_folder
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import write_benchmark

if TYPE_CHECKING:
    pass


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "instances", "draw the benchmark's instances (paper, Table III)")
    p.add_argument("--count", type=positive, default=500)
    p.add_argument("--seed", type=natural, default=2022)
    p.add_argument("--case", default=DEFAULT_CASE, help="name of a shipped case, or a folder")
    p.add_argument("--test", type=positive, help="how many are for testing (default: a fifth)")
    p.add_argument("--out", type=Path, help="default: the case's own folder")
    p.set_defaults(run=_instances)


def _instances(a: argparse.Namespace) -> int:
    from ded_bench.truth.servable import servable

    case = Case.load(a.case)
    folder = a.out or problem_folder(a.case, case)
    manifest = write_benchmark(case, a.count, a.seed, folder, a.test, servable)
    print(f"{a.count} instances of {case.id} (seed {a.seed}) in {folder}, version {manifest.version}")
    if manifest.redraws:
        print(f"{manifest.redraws} loads or instances were drawn again: their sign changed, or no power flow")
    return 0
