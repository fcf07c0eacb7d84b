"""The command line: arguments, and the commands that parse, call and print."""

from ded_bench.cli.commands import main

__all__ = ["main"]
