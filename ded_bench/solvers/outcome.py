"""What a solver answers, and what a compiled model can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from ded_bench.solvers.status import Status

#: A solver's own options by name.
Options = Mapping[str, Any]


@dataclass(frozen=True)
class Outcome:
    """What a solver reports; values are in the Pyomo model if `has_values`."""

    status: Status
    has_values: bool
    iterations: int | None
    setup_s: float
    solve_s: float
    objective: float | None
    version: str
    message: str


class Compiled(Protocol):
    """A model ready to be solved again and again."""

    def solve(self, time_limit_s: float | None = None) -> Outcome:
        """Solve for the current variable bounds and initial values; the first call pays for set-up."""
        ...
