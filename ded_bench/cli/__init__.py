"""The command line: arguments, and the commands that parse, call and print."""

import sys

if sys.platform == "win32":
    sys.exit("ded-bench: needs Linux or macOS (on Windows: the Windows Subsystem for Linux)")

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    try:
        from ded_bench.cli.commands import main as run  # a second, in which one may think better of it

        return run(argv)
    except KeyboardInterrupt:
        print("ded-bench: interrupted; run again to continue (trainings: with --resume)", file=sys.stderr)
        return 130
