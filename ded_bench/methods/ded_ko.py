"""DED-KO: the paper's linear program over all points of the horizon, on a surrogate.

Every grid point is a knot of the program (see `knot_program`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ded_bench.methods.options import NoOptions
from ded_bench.methods.solution import Settings, Solution, Solver, too_large
from ded_bench.methods.surrogate_program import solve_on_surrogate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import Surrogate, find_surrogate
from ded_bench.surrogates.koopman import Koopman

Options = NoOptions
#: Raised when answers change.
VERSION = 1
#: Limit where none is given: HiGHS, the last resort, knows no end on large grids.
TIME_LIMIT_S = 1800.0
#: Bytes that a program takes for each entry of its equations (39bus).
BYTES_PER_ENTRY = 150


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances on the surrogate that the settings name."""
    surrogate = find_surrogate(case, settings.model or "koopman", settings.search)
    return prepare_with(case, surrogate, regime, settings)


def prepare_with(case: Case, surrogate: Surrogate, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances."""
    case.check_regimes([regime])
    limit_s = TIME_LIMIT_S if settings.time_limit_s is None else settings.time_limit_s

    def solve(instance: Instance) -> Solution:
        points = np.arange(instance.steps + 1)
        needed = BYTES_PER_ENTRY * _entries(case, surrogate, instance.steps)
        if refusal := too_large(needed, f"the program of {len(points)} points", "`ded-ko-knots` takes fewer"):
            return refusal
        # Softly, since one widening for all of thousands of intervals would be a dense column.
        solution = solve_on_surrogate(
            case, surrogate, instance, case.bounds(regime), points, limit_s, soft=True
        )
        return replace(solution, schedule=None) if solution.status == Status.INFEASIBLE else solution

    return solve


def _entries(case: Case, surrogate: Surrogate, steps: int) -> int:
    """Entries of the equations of the program of all points, if all blocks are dense."""
    n_gen = len(case.generators)
    n_state = len(surrogate.k) if isinstance(surrogate, Koopman) else 2 * n_gen
    return steps * n_state * (n_state + 2 * n_gen + 1)
