"""What a solver reports, as a method's answer."""

from __future__ import annotations

from collections.abc import Callable

from ded_bench.methods.solution import Solution
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.outcome import Outcome


def answer(outcome: Outcome, build_s: float, schedule: Callable[[], Schedule | None]) -> Solution:
    """A solver's outcome as the method's answer; the schedule is read only if there is one."""
    return Solution(
        status=outcome.status,
        schedule=schedule() if outcome.has_values else None,
        iterations=outcome.iterations,
        build_s=build_s,
        setup_s=outcome.setup_s,
        solve_s=outcome.solve_s,
        solver_objective=outcome.objective,
        solver_version=outcome.version,
        error="" if outcome.has_values else outcome.message,
    )
