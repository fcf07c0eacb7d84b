"""The one exception that means: the input is at fault, not the program."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Something the user gave is wrong; the message names source, field and problem.

    The command line prints it as one line and exits with code 2.
    """

    def __init__(self, source: str | Path, field: str, problem: str) -> None:
        self.source, self.field, self.problem = str(source), field, problem
        super().__init__(": ".join(part for part in (self.source, field, problem) if part))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return InputError, (self.source, self.field, self.problem)
