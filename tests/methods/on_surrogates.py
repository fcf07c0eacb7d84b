"""What a schedule does on a Koopman model, step by step; instances to try it on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from ded_bench.methods import ded_ko, ded_ko_knots
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import OMEGA_TOLERANCE
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.surrogates.koopman import Koopman

HORIZON = 3.0
METHODS = (ded_ko, ded_ko_knots)


def short(case: Case, index: int, **changes) -> Instance:
    """An instance whose loads ramp from the start and whose slack costs differ with the index."""
    instance = sample_instance(case, 77, index)
    load = {bus: ramp.model_copy(update={"start": 0.5}) for bus, ramp in instance.load.items()}
    return instance.model_copy(update={"horizon_s": HORIZON, "load": load, **changes})


class Replay(NamedTuple):
    """What the Koopman model makes of a schedule, computed step by step."""

    objective: float
    omega: Array
    p_slack: Array


def replay(case: Case, koopman: Koopman, instance: Instance, schedule: Schedule) -> Replay:
    p_gen = schedule.at(instance.grid)
    psi = koopman.initial([instance])[0]
    out = koopman.rollout(psi, np.hstack([p_gen, instance.p_load(case)]))
    n_gen = len(case.generators)
    p_slack = out[:, n_gen]
    cost = p_gen @ instance.cost_gen(case) + instance.cost_slack(case) * np.abs(p_slack)
    return Replay(float(cost.sum()), out[:, :n_gen], p_slack)


def check_limits(case: Case, koopman: Koopman, instance: Instance, solution: Solution, regime: str) -> Replay:
    """Every constraint at every point, and the objective that the solver claims."""
    assert solution.status == Status.OPTIMAL
    p_gen = solution.schedule.at(instance.grid)
    model = replay(case, koopman, instance, solution.schedule)
    assert model.objective == pytest.approx(solution.solver_objective, rel=1e-8)
    assert (np.abs(model.omega[1:]) - case.omega_bound(regime)).max() <= 1.1 * OMEGA_TOLERANCE
    assert (np.abs(np.diff(p_gen, axis=0)) <= case.ramp * instance.dt_s + 1e-9).all()
    assert (p_gen - case.p_max).max() <= 1e-8
    assert (case.p_min - p_gen).max() <= 1e-8
    assert p_gen[0].tolist() == instance.p_initial(case).tolist()
    return model


def prepared(method, case: Case, surrogate, regime: str, settings: Settings | None = None):
    """A method's solver on a surrogate that lies in no file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(method, "find_surrogate", lambda *_: surrogate)
        return method.prepare(case, regime, settings or Settings())
