"""The command line: arguments, and the commands that parse, call and print."""

import sys

if sys.platform == "win32":
    sys.exit("ded-bench: needs Linux or macOS (on Windows: the Windows Subsystem for Linux)")

from ded_bench.cli.commands import main

__all__ = ["main"]
