"""What a solver claims, in a word and in a sentence, and what it reports."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Status(enum.StrEnum):
    """What the solver claims; the scorer's verdict stands in other columns."""

    OPTIMAL = "Optimal"
    FEASIBLE = "Feasible"
    INFEASIBLE = "Infeasible"
    TIME_LIMIT = "TimeLimit"
    FAILED = "Failed"
    POLICY = "Policy"

    @property
    def sentence(self) -> str:
        """The status in words."""
        return {
            Status.OPTIMAL: "the solver reports an optimum within its tolerances",
            Status.FEASIBLE: "the method gives a schedule without a claim of optimality",
            Status.INFEASIBLE: "the solver reports that no schedule of its kind meets every constraint",
            Status.TIME_LIMIT: "the time limit passed before the solver finished",
            Status.FAILED: "the method ended without a schedule",
            Status.POLICY: "a trained policy was evaluated; no solver ran",
        }[self]


@dataclass(frozen=True)
class Outcome:
    """What a solver reports; values are in the Pyomo model if there is an objective."""

    status: Status
    iterations: int | None
    setup_s: float
    solve_s: float
    objective: float | None
    version: str
    message: str
