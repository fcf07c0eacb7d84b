"""Methods that misbehave, for the runner's tests."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from ded_bench.methods.options import NoOptions
from ded_bench.methods.registry import METHODS, Method
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run import tasks
from ded_bench.solvers.status import Status

Options = NoOptions
VERSION = 3
STRANGE = Method("ded", "tests.strange_methods", "strange")


def solve_strange(case: Case, task: tasks.Task, plant: str) -> object:
    """`solve_and_score` for worker processes, which import afresh: tells them where the strange method is."""
    METHODS["ded"] = STRANGE
    return tasks.solve_and_score(case, task, plant)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Behave as the instance's id says; count every call in a file, if there is one to count in."""

    def solve(instance: Instance) -> Any:
        name = instance.id
        log = Path(os.environ.get("STRANGE_LOG", os.devnull))
        with log.open("a") as file:
            file.write(f"{name}\n")
        power = instance.p_initial(case)
        if "apart" in name:
            power = power + 1e6
        schedule = Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power]))
        if "raise" in name:
            raise ValueError("no idea how\nand more")
        if "crash" in name:
            os.kill(os.getpid(), 11)
        if "once" in name and log.read_text().count(name) < 2:
            os._exit(9)
        if "hang" in name:
            time.sleep(600.0)
        if "slow" in name:
            time.sleep(1.0)
        if "wrong" in name:
            return 42
        if "huge" in name:
            return Solution(Status.FEASIBLE, schedule, np.int64(3), solver_objective=1e300, error="a\nb")
        return Solution(Status.FEASIBLE, schedule, solve_s=1e-3)

    return solve
