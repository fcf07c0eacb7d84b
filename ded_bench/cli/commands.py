"""The `ded-bench` commands: parse, call, print; exit code 0, 1 (work failed) or 2 (bad input)."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from ded_bench.cli import (
    evaluation_commands,
    online_commands,
    problem_commands,
    solve_commands,
    training_commands,
)
from ded_bench.cli.arguments import ROAD, OneLinePerCommand, Parser, say
from ded_bench.files.errors import InputError
from ded_bench.run.environment import version
from ded_bench.run.pool import WorkersLostError


def parser() -> argparse.ArgumentParser:
    """The parser of all commands; `run` is the function of the one chosen."""
    top = Parser(
        prog="ded-bench",
        description="Benchmark suite for the dynamics-aware economic dispatch (DED) problem.",
        epilog=ROAD,
        formatter_class=OneLinePerCommand,
    )
    shown = f"%(prog)s {version()}"
    top.add_argument("--version", action="version", version=shown, help="show the version and exit")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for group in (problem_commands, training_commands, solve_commands, evaluation_commands, online_commands):
        group.add_commands(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a locale may lack arrows and Greek letters
            stream.reconfigure(errors="replace")
    try:
        arguments = parser().parse_args(argv)
        if sys.stderr and sys.stderr.isatty():  # imports take a second, and some commands work for minutes
            say(f"{arguments.task} ...")
        code: int = arguments.run(arguments)
        return code
    except (InputError, WorkersLostError) as error:
        say(str(error))
        return 2 if isinstance(error, InputError) else 1
    except BrokenPipeError:
        return 1
    except OSError as error:  # a full disk, a folder that is read-only or a file
        place = f"{error.filename}: " if error.filename else ""
        say(f"{place}{error.strerror or error}")
        return 2
