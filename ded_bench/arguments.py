"""What the `ded-bench` commands accept: options, defaults, help."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any, NoReturn

from ded_bench.koopman.store import MODELS, TRAINED
from ded_bench.methods import METHODS
from ded_bench.problem.benchmark import SPLITS

#: The shipped case that is meant where none is named.
DEFAULT_CASE = "9bus"
KNOWN = ", ".join(METHODS)
MODEL_HELP = f"{', '.join(MODELS)}, or a file"


#: Under the list of commands, which must fit a terminal of 24 lines and 80 columns.
ROAD = (
    "The road: instances, train-ko, solve, train-dpc, solve, bench, report; `make report` walks it. "
    "`ded-bench COMMAND --help` lists the options of one."
)


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        self.exit(2, f"{self.prog}: {message} (`{self.prog} --help` lists what there is)\n")


class _OneLinePerCommand(argparse.HelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=16, width=79)
        self._action_max_length = 14  # argparse forgets that commands are indented once more


def parser() -> argparse.ArgumentParser:
    """The parser of all commands; `command` is the name of the one chosen."""
    top = Parser(
        prog="ded-bench",
        description="Benchmark suite for the dynamics-aware economic dispatch (DED) problem.",
        epilog=ROAD,
        formatter_class=_OneLinePerCommand,
    )
    commands = top.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)

    p = _command(commands, "instances", "draw the benchmark's instances (paper, Table III)")
    p.add_argument("--count", type=_positive, default=500)
    p.add_argument("--seed", type=_natural, default=2022)
    p.add_argument("--case", default=DEFAULT_CASE, help="name of a shipped case, or a folder")
    p.add_argument("--out", type=Path, help="default: the case's own folder")

    p = _command(commands, "train-ko", "identify the Koopman model from simulated trajectories")
    p.add_argument("--kind", choices=TRAINED, default=TRAINED[0], help="ours, or the paper's recipe")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--seed", type=_natural, default=0)
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="model file; default: in the results folder")
    p.add_argument("--force", action="store_true", help="train even if the file exists")

    p = _command(commands, "solve", "solve instances with methods, score, one row each")
    p.add_argument(
        "--method", type=_names, required=True, metavar="M[,M]", help=f"{KNOWN}, or module:function"
    )
    p.add_argument("--regime", type=_names, required=True, metavar="R[,R]", help="NO, TO")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=SPLITS, default="test", help="default: test")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE", help="instead of a split")
    p.add_argument("--limit", type=_positive, help="only the first so many of the split")
    p.add_argument("--case", help="name of a shipped case, or a folder")
    p.add_argument("--settings", default="default", help="slug of the method's settings")
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")
    where = p.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_positive, metavar="N", help="processes here (default: 1)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    p.add_argument(
        "--time-limit", type=_positive_number, metavar="S", help="per solve; 60 s later it is killed"
    )
    p.add_argument("--out", type=Path, help="results folder")

    p = _command(commands, "train-dpc", "train a policy on the training instances")
    p.add_argument("--method", default="ded-dpc", help="ded-dpc or ded-dpc-paper")
    p.add_argument("--settings", default="default", help="slug of the training settings")
    p.add_argument("--regime", required=True, metavar="R", help="NO or TO")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--seed", type=_natural, default=0)
    budget = p.add_mutually_exclusive_group()
    budget.add_argument("--seconds", type=_positive_number, metavar="S", help="train for so long")
    budget.add_argument("--epochs", type=_positive, metavar="N")
    p.add_argument("--limit", type=_positive, help="only the first so many training instances")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="policy file; default: in the results folder")

    p = _command(commands, "bench", "time methods, each alone on the machine, one thread")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--method", type=_names, metavar="M[,M]", help="default: all in the results")
    p.add_argument("--instances", type=_positive, default=10, help="how many test instances to time")
    p.add_argument("--repeats", type=_positive, help="solves of each; default: by the method's speed")
    p.add_argument("--force", action="store_true", help="time again what timing.csv holds")
    p.add_argument("--results", type=Path, help="results folder")

    p = _command(commands, "report", "write tables V and VI, figures, report.md and report.html")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--workers", type=_positive, default=min(os.cpu_count() or 1, 4), help="that draw figures")
    p.add_argument("--results", type=Path, help="results folder")

    p = _command(commands, "score", "simulate schedule CSVs on the true system and judge them")
    given = p.add_mutually_exclusive_group(required=True)
    given.add_argument("--schedule", type=Path, metavar="CSV", help="one, for one --instance")
    given.add_argument("--schedules", type=Path, metavar="DIR", help="[REGIME/]INSTANCE.csv[.gz] become rows")
    p.add_argument("--name", help="what the rows of --schedules call your method")
    p.add_argument("--regime", type=_names, required=True, metavar="R[,R]", help="NO, TO")
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=SPLITS, default="test", help="default: test")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE", help="instead of a split")
    p.add_argument("--limit", type=_positive, help="only the first so many of the split")
    p.add_argument("--case", help="name of a shipped case, or a folder")
    p.add_argument("--workers", type=_positive, default=1)
    p.add_argument("--out", type=Path, help="results folder for the rows of --schedules")
    p.add_argument("--json", action="store_true", help="one JSON object per schedule")

    p = _command(commands, "compare", "what changed between two results folders")
    p.add_argument("a", type=Path, metavar="A", help="the results folder that sets the standard")
    p.add_argument("b", type=Path, metavar="B")
    p.add_argument("--tolerance", type=_not_negative, default=1e-6, metavar="X", help="objective, relative")
    p.add_argument("--tolerance-hz", type=_not_negative, default=1e-6, metavar="HZ", help="violations")
    p.add_argument("--tolerance-pu", type=_not_negative, default=1e-8, metavar="PU", help="violations")
    p.add_argument("--common", action="store_true", help="rows that only one has are no difference")
    p.add_argument("--json", action="store_true", help="one JSON object instead of lines")

    p = _command(commands, "certify", "certify a policy on fresh instances")
    p.add_argument("--method", default="ded-dpc")
    p.add_argument("--regime", type=_names, default=("NO", "TO"), metavar="R[,R]")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--settings", default="default")
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")
    p.add_argument("--count", type=_positive, default=10_000, metavar="M", help="how many fresh instances")
    p.add_argument("--seed", type=_natural, default=0)
    p.add_argument("--gap", type=_positive_number, default=1.0, metavar="PERCENT", help="over ded-ko-knots")
    p.add_argument("--tolerance", type=_positive_number, default=1e-6, metavar="HZ", help="of the frequency")
    p.add_argument("--delta", type=_positive_number, default=0.01, help="1 - confidence")
    p.add_argument("--workers", type=_positive, default=1)
    p.add_argument("--results", type=Path, help="results folder")

    p = _command(commands, "rollouts", "errors of the Koopman models under full DED's schedules")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--results", type=Path, help="results folder")
    return top


def _command(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = commands.add_parser(
        name, help=text, description=f"{text[:1].upper()}{text[1:]}."
    )
    return made


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


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def _positive_number(text: str) -> float:
    if (value := _not_negative(text)) == 0:
        raise argparse.ArgumentTypeError("must be above 0")
    return value
