"""DED-KO on the case's knots: the linear program restricted to schedules that are linear between them.

Knots are rounded to the grid, as those of `ded-slp`. On `trajectory` an instance is simulated once, under
the static dispatch of every second, followed slowly, and linearised once; unlike `ded-slp` nothing confirms
the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

from ded_bench.methods.knots import case_knots
from ded_bench.methods.options import NoOptions
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import solve_on_surrogate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.surrogates.find import Surrogate, find_surrogate

Options = NoOptions
#: Raised when answers change.
VERSION = 1


def prepare(case: Case, regime: str, settings: Settings) -> KnotSolver:
    """Return a solver of single instances on the surrogate that the settings name."""
    surrogate = find_surrogate(case, settings.model, settings.search)
    return KnotSolver(case, surrogate, regime, settings.time_limit_s)


@dataclass(frozen=True)
class KnotSolver:
    """Solves instances of one case and regime on one surrogate."""

    case: Case
    surrogate: Surrogate
    regime: str
    time_limit_s: float | None = None

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: of no meaning here.
        """
        return self(instance, soft=True)

    def __call__(self, instance: Instance, soft: bool = False) -> Solution:
        """Solve one instance; `Infeasible` comes with a schedule if `soft`."""
        points, bounds = case_knots(self.case, instance), self.case.bounds(self.regime)
        return solve_on_surrogate(
            self.case, self.surrogate, instance, bounds, points, self.time_limit_s, soft
        )
