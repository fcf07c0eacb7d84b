"""Methods of others that fail at every third plan, for the loop's tests."""

from __future__ import annotations

import time

import numpy as np

from ded_bench.methods import ed
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status


def _third(instance: Instance) -> bool:
    """Whether this is the third, sixth, ... plan of a loop with a period of a second."""
    return round(int(instance.id.rsplit("-", 1)[1]) * instance.dt_s) % 3 == 2


def raises(instance: Instance, regime: str, case: Case) -> Schedule:
    """Raise an error."""
    if _third(instance):
        raise ValueError("no idea how")
    return ed.dispatch(case, instance, 1.0)


def lost(instance: Instance, regime: str, case: Case) -> Schedule:
    """Never knows."""
    return {}["power"]  # type: ignore[no-any-return,index]


def nonsense(instance: Instance, regime: str, case: Case) -> Schedule:
    """Answer with what is no number."""
    if _third(instance):
        return Schedule(np.array([0.0, instance.horizon_s]), np.full((2, len(case.generators)), np.nan))
    return ed.dispatch(case, instance, 1.0)


def sleeps(instance: Instance, regime: str, case: Case) -> Schedule:
    """Take longer than anyone waits."""
    if _third(instance):
        time.sleep(600.0)
    return ed.dispatch(case, instance, 1.0)


def slow(instance: Instance, regime: str, case: Case) -> Schedule:
    """Take half a second."""
    time.sleep(0.5)
    return ed.dispatch(case, instance, 1.0)


def never(instance: Instance, regime: str, case: Case) -> Schedule:
    """Have no answer at all."""
    raise ValueError("never")


class Strained:
    """Goes on as before, and says at every third plan that no schedule meets every limit."""

    def __init__(self, case: Case) -> None:
        self.case = case

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Answer with the plan in force, if there is one."""
        schedule = ed.dispatch(self.case, instance, 1.0) if last is None else last.schedule
        return Solution(Status.INFEASIBLE if _third(instance) else Status.FEASIBLE, schedule)


def strained(case: Case, regime: str, settings: Settings) -> Strained:
    """Return an object that solves."""
    return Strained(case)
