"""The command that lists methods and their options."""

from __future__ import annotations

import argparse
import textwrap
from typing import Any

from ded_bench.cli.arguments import command
from ded_bench.files.errors import InputError
from ded_bench.methods.options import described
from ded_bench.methods.registry import Method, get_method, registered


def add_commands(commands: Any) -> None:
    """Declare this command and its options."""
    p = command(commands, "methods", "list methods, their options and defaults")
    p.add_argument("name", nargs="?", metavar="NAME", help="only this one; default: all")
    p.set_defaults(run=_methods)


def _methods(a: argparse.Namespace) -> int:
    chosen = [get_method(a.name)] if a.name else registered().values()
    print("\n".join(line for method in chosen for line in lines_of(method)))
    return 0


def lines_of(method: Method) -> list[str]:
    """A line for a method, and one for each of its options; what cannot be imported says why."""
    try:
        options = described(method.options)
    except InputError as error:
        return [f"{method.name:<16} cannot be used: {error}"]
    lines = [f"{method.name:<16} {method.title}"]
    for name, default, text in options:
        lines += textwrap.wrap(f"  {f'{name}={default}':<20} {text}", 110, subsequent_indent=" " * 23)
    return lines
