"""What commands say on stderr, beside their answers on stdout."""

from __future__ import annotations

import sys


def say(sentence: str) -> None:
    """Tell on stderr what a command is about to do, before the imports and the work that take seconds."""
    print(f"ded-bench: {sentence}", file=sys.stderr, flush=True)


def counted(n: int, noun: str) -> str:
    """A number of things: `1 row`, `2 rows`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
