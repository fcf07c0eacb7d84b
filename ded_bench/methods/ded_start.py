"""Full DED that starts from a schedule instead of the state at t = 0: is its optimum the same from all?

These are the settings `start-...` of `ded`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pyomo.environ as pyo

from ded_bench.koopman.linear import linear_model
from ded_bench.methods import ded, ded_ko, ed
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.simulate import simulate

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
    return ed.follow_set_points(case, instance, targets, RANDOM_INTERVAL_S)


#: Schedule to start from, by settings slug.
SETTINGS: Mapping[str, Mapping[str, Callable[[Case, Instance, str], Schedule]]] = {
    "start-ed": {"schedule": dispatched},
    "start-ko": {"schedule": linearised},
    "start-random": {"schedule": random},
}


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; the schedule's trajectory is part of the time to build."""
    schedule = SETTINGS[settings.name]["schedule"]

    def start(model: pyo.ConcreteModel, instance: Instance) -> None:
        start_from(model, case, instance, schedule(case, instance, regime))

    return ded.prepare_with(case, regime, settings.time_limit_s, start=start)


def start_from(m: pyo.ConcreteModel, case: Case, instance: Instance, schedule: Schedule) -> None:
    """Make the initial point of a model that is set to an instance what a schedule does on the true DAE.

    Raises:
        SimulationError: the system loses synchronism under this schedule.
    """
    truth = simulate(case, instance, schedule)
    ded.set_start(m, case, truth.theta, truth.omega, truth.p_gen, truth.p_slack)
