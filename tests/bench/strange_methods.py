"""Methods that misbehave, for the runner's tests."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ded_bench.methods.solution import Settings, Solution, Solver, Status
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

SETTINGS = {"default": {}}


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Behave as the instance's id says; count every call in a file."""

    def solve(instance: Instance) -> Solution:
        with Path(os.environ["STRANGE_LOG"]).open("a") as log:
            log.write(f"{instance.id}\n")
        if "raise" in instance.id:
            raise ValueError("no idea how")
        if "crash" in instance.id:
            os.kill(os.getpid(), 11)
        if "once" in instance.id and Path(os.environ["STRANGE_LOG"]).read_text().count(instance.id) < 2:
            os._exit(9)
        power = instance.p_initial(case)
        if "apart" in instance.id:
            power = power + 1e6
        schedule = Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power]))
        return Solution(Status.FEASIBLE, schedule, solve_s=1e-3)

    return solve
