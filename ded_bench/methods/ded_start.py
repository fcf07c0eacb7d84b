"""Schedules that full DED may start from instead of the state at t = 0: is its optimum the same from all?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ded_bench.koopman.linear import linear_model
from ded_bench.methods import ded_ko, ed
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: Seconds between the set-points of a random schedule.
RANDOM_INTERVAL_S = 5.0


def dispatched(case: Case, instance: Instance, regime: str) -> Schedule:
    """Traditional dispatch every second."""
    return ed.dispatch(case, instance, interval_s=1.0)


def linearised(case: Case, instance: Instance, regime: str) -> Schedule:
    """DED-KO on the linearisation at the nominal point; traditional dispatch where it has no solution."""
    koopman = linear_model(case)
    solution = ded_ko.prepare_with(case, koopman, regime, Settings())(instance)
    return solution.schedule or dispatched(case, instance, regime)


def random(case: Case, instance: Instance, regime: str) -> Schedule:
    """Set-points drawn from within the generator bounds, followed at the ramp limit; the same every time."""
    rng = np.random.default_rng(list(instance.fingerprint.encode()))
    count = int(np.ceil(instance.horizon_s / RANDOM_INTERVAL_S))
    targets = rng.uniform(case.p_min, case.p_max, size=(count, len(case.generators)))
    return ed.follow(case, instance, targets, RANDOM_INTERVAL_S)


#: Start by the name that follows `start-` in the settings' slug.
STARTS: dict[str, Callable[[Case, Instance, str], Schedule]] = {
    "ed": dispatched,
    "ko": linearised,
    "random": random,
}
