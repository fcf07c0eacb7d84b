"""One instance's linear program on a surrogate, for any knots: what `ded-ko` and `ded-ko-knots` share.

What it claims is what the surrogate says: no answer is simulated.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ded_bench.methods import ed
from ded_bench.methods.first_schedules import first_schedules
from ded_bench.methods.knot_program import KnotProgram, solve_with_rows_added
from ded_bench.methods.knots import is_reachable
from ded_bench.methods.solution import Solution
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.time_varying import Indices, TimeVarying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import Surrogate
from ded_bench.surrogates.instance_model import model_along

#: What a program may leave open between points that have rows, rad/s: half of what strict feasibility allows.
OMEGA_TOLERANCE = 2 * np.pi * 5e-7
#: The surrogate's model is taken along the static dispatch, followed at this part of the ramp limits: as fast
#: as they allow, frequency swings tens of times farther than a tight bound lets it, and the linear model's
#: error grows with the square of the distance (two-area, TO, validation draws: 0.48 mHz at 1, 0.06 at 0.3,
#: 0.03 at 0.2 and 0.1, 0.05 at 0.05).
PACE = 0.2


def solve_on_surrogate(
    case: Case,
    surrogate: Surrogate,
    instance: Instance,
    regime: str,
    points: Indices,
    time_limit_s: float | None = None,
    soft: bool = False,
) -> Solution:
    """Solve one instance on a surrogate: the best schedule that is linear between knots.

    The surrogate's model is taken along the static dispatch of every second, followed slowly, or along what
    the network can carry instead; rows of the frequency bound are added to one program until all grid
    points keep it.

    Args:
        case: the grid.
        surrogate: what stands for the swing equations.
        instance: what to solve.
        regime: gives the bound of |ω|.
        points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        time_limit_s: s.
        soft: `Infeasible` comes with the schedule of least frequency excess, summed over knot intervals.
    """

    def along(p_gen: Array) -> TimeVarying:
        return model_along(case, surrogate, instance, p_gen, points)

    return solve_along(case, instance, regime, points, along, time_limit_s, soft)


def solve_along(
    case: Case,
    instance: Instance,
    regime: str,
    points: Indices,
    along: Callable[[Array], TimeVarying],
    time_limit_s: float | None = None,
    soft: bool = False,
) -> Solution:
    """`solve_on_surrogate` on any linear model.

    Args:
        case: the grid.
        instance: what to solve.
        regime: gives the bound of |ω|.
        points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        along: makes the model of this instance along powers at the knots, shape (n_knots, n_gen), pu;
            SimulationError if the system cannot follow them.
        time_limit_s: s.
        soft: see `solve_on_surrogate`.
    """
    started = time.perf_counter()
    deadline = started + (np.inf if time_limit_s is None else time_limit_s)
    if not is_reachable(case, instance, points):
        return _without(Status.INFEASIBLE, Status.INFEASIBLE.sentence, started)
    dispatched, model = reference(case, instance, points), None
    for p_gen in first_schedules(case, instance, dispatched, points):
        try:
            model = along(p_gen)
            break
        except SimulationError as error:
            reason = str(error)
    if model is None:
        return _without(Status.FAILED, reason, started)
    program = KnotProgram(case, instance, case.omega_bound(regime), model)
    built = time.perf_counter()
    attempt = solve_with_rows_added(
        program, set(), OMEGA_TOLERANCE, OMEGA_TOLERANCE, deadline, by_interval=soft
    )
    schedule, objective, reason = None, None, ""
    if attempt.prediction is not None and (soft or attempt.status == Status.OPTIMAL):
        schedule = Schedule(instance.grid[points], attempt.prediction.p_gen)
    if attempt.status == Status.OPTIMAL and attempt.prediction is not None:
        objective = attempt.prediction.objective
    else:
        reason = attempt.message if attempt.status == Status.FAILED else attempt.status.sentence
    return Solution(
        status=attempt.status,
        schedule=schedule,
        iterations=attempt.iterations,
        build_s=built - started,
        setup_s=0.0,
        solve_s=time.perf_counter() - built,
        solver_objective=objective,
        solver_version=attempt.version,
        error=reason,
    )


def reference(case: Case, instance: Instance, points: Indices) -> Array:
    """The static dispatch of every second, followed slowly: powers at the knots, (n_knots, n_gen), pu."""
    p_gen = ed.dispatch(case, instance, 1.0).at(instance.grid[points])
    reach = PACE * np.outer(np.diff(points) * instance.dt_s, case.ramp)
    for j, most in enumerate(reach):
        p_gen[j + 1] = p_gen[j] + np.clip(p_gen[j + 1] - p_gen[j], -most, most)
    return p_gen


def _without(status: Status, error: str, started: float) -> Solution:
    """An answer found before there was a program."""
    return Solution(status, build_s=time.perf_counter() - started, setup_s=0.0, solve_s=0.0, error=error)
