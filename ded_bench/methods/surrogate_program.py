"""One instance's linear program on a surrogate: what `ded-ko`, `ded-ko-knots` and `ded-rti` share.

What it claims is what the surrogate says: no answer is simulated.
"""

from __future__ import annotations

import time

import numpy as np

from ded_bench.methods.ed import first_schedules, slow_dispatch, within_ramps
from ded_bench.methods.knot_program import KnotProgram, Plan, Prediction
from ded_bench.methods.knots import is_reachable
from ded_bench.methods.slp import Attempt, Parts, Rows, sequence, solve_with_rows_added
from ded_bench.methods.solution import Solution
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import Surrogate

#: What a program may leave open between points that have rows, rad/s: half of what strict feasibility allows.
OMEGA_TOLERANCE = 2 * np.pi * 5e-7
#: With priced excess: excess that is left open, as a part of the bound.
SOFT_TOLERANCE = 0.02


def solve_on_surrogate(
    case: Case,
    surrogate: Surrogate,
    instance: Instance,
    bounds: Bounds,
    points: Indices,
    time_limit_s: float | None = None,
    soft: bool = False,
    plan: Plan | None = None,
) -> Solution:
    """Solve one instance on a surrogate: the best schedule that is linear between knots.

    The surrogate's model is taken along the static dispatch of every second, followed slowly, or along a plan
    in force, or along what the plant can carry instead; rows of the frequency bound are added to one program
    until all grid points keep it.

    Args:
        case: the grid.
        surrogate: what stands for the plant.
        instance: what to solve.
        bounds: of outputs of ω.
        points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        time_limit_s: s.
        soft: `Infeasible` comes with the schedule of least frequency excess, summed over knot intervals.
        plan: correct a plan instead; `Infeasible` comes with the schedule that the price makes cheapest.
    """
    started = built = time.perf_counter()
    deadline = started + (np.inf if time_limit_s is None else time_limit_s)
    left = OMEGA_TOLERANCE if plan is None else SOFT_TOLERANCE * float(bounds.limit.min())
    rows = Rows(left, left, soft=plan is not None)

    def follow(p_gen: Array) -> TimeVarying:
        return surrogate.along(instance, p_gen, points, plan is None, plan and plan.state)

    def solve(model: TimeVarying, _: int) -> Attempt[Prediction]:
        nonlocal built
        program = KnotProgram(case, instance, bounds, model, plan)
        built = time.perf_counter()
        is_near = plan is not None and plan.last is not None
        limits = program.near(program.model.omega, widened=np.zeros(len(points) - 1)) if is_near else set()
        return solve_with_rows_added(program, limits, rows, deadline)

    if not is_reachable(case, instance, points):
        status, reason, attempt = Status.INFEASIBLE, "", None
    else:
        if plan is None or plan.last is None:
            wanted = slow_dispatch(case, instance, points)
        else:
            wanted = within_ramps(case, instance, plan.last, points)
        first = first_schedules(case, instance, wanted, points)
        end = sequence(Parts(follow, solve, stop=None), first, np.inf)
        status, reason, attempt = end.status, end.message, end.answer
    prediction = attempt.solution if attempt else None
    is_optimal = status == Status.OPTIMAL
    is_given = prediction is not None and (is_optimal or soft or plan is not None)
    return Solution(
        status=status,
        schedule=Schedule(instance.grid[points], prediction.p_gen) if prediction and is_given else None,
        iterations=attempt.iterations if attempt else None,
        build_s=(built if attempt else time.perf_counter()) - started,
        setup_s=0.0,
        solve_s=time.perf_counter() - built if attempt else 0.0,
        solver_objective=prediction.objective if prediction and is_optimal else None,
        solver_version=attempt.version if attempt else "",
        error="" if is_optimal else reason if status == Status.FAILED else status.sentence,
    )
