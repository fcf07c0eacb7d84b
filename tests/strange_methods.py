"""Methods that misbehave, for the runner's tests."""

from __future__ import annotations

import dataclasses
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


def solve_strange(case: Case, task: tasks.Task) -> object:
    """`solve_task` for worker processes, which import afresh: tells them where the strange method is."""
    METHODS["ded"] = STRANGE
    return tasks.solve_task(case, task)


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
        if "infeasible" in name:
            return Solution(Status.INFEASIBLE, error="no way")
        if "wrong" in name:
            return 42
        if "nothing" in name:
            return Solution(Status.OPTIMAL)
        if "shape" in name:
            return Solution(Status.OPTIMAL, Schedule(schedule.t, np.ones((2, 7))))
        if "nan" in name:
            return Solution(Status.OPTIMAL, Schedule(schedule.t, schedule.p * np.nan))
        solution = Solution(Status.FEASIBLE, schedule, solve_s=1e-3)
        if "huge" in name:
            return dataclasses.replace(solution, solver_objective=1e300, error="a\nb", iterations=np.int64(3))
        if "numpy" in name:
            return dataclasses.replace(solution, solver_objective=np.float64(1.5), solve_s=np.float32(0.5))
        return solution

    return solve
