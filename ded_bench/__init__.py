"""ded-bench: a benchmark suite for the dynamics-aware economic dispatch (DED) problem.

What a notebook needs: `load_instances` → `solve` → `simulate` or `score`. A case need not be given
where the suite ships it; every library is imported when first used.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from ded_bench.files.errors import InputError as InputError
    from ded_bench.methods.solution import Settings as Settings
    from ded_bench.methods.solution import Solution as Solution
    from ded_bench.methods.solution import Solver
    from ded_bench.plants.plant import Plant
    from ded_bench.plants.plant import SimulationError as SimulationError
    from ded_bench.plants.score import Score as Score
    from ded_bench.problem.benchmark import SplitName
    from ded_bench.problem.case import Case as Case
    from ded_bench.problem.instance import Instance as Instance
    from ded_bench.problem.schedule import Schedule as Schedule
    from ded_bench.problem.schedule import Trajectory as Trajectory
    from ded_bench.solvers.status import Status as Status

#: Where each name is from that is imported when it is first asked for.
_HOMES = {
    "Case": "problem.case",
    "InputError": "files.errors",
    "Instance": "problem.instance",
    "Schedule": "problem.schedule",
    "Score": "plants.score",
    "Settings": "methods.solution",
    "SimulationError": "plants.plant",
    "Solution": "methods.solution",
    "Status": "solvers.status",
    "Trajectory": "problem.schedule",
}
__all__ = [*_HOMES, "load_instances", "score", "simulate", "simulate_many", "solve"]


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for, and look up the version."""
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("ded-bench")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"ded_bench.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def load_instances(case: str | Path, split: SplitName = "test", limit: int | None = None) -> list[Instance]:
    """Read the benchmark's instances of a split, in the order of their ids.

    Args:
        case: name of a shipped case, or a benchmark's folder.
        split: `test`, `train`, `validation` (drawn afresh) or `all`.
        limit: only the first so many.

    Raises:
        InputError: there is no such case or split, the limit is negative, or a file is missing or wrong.
    """
    from ded_bench.plants.plant import servable
    from ded_bench.problem.benchmark import select_split

    return [instance for instance, _ in select_split(case, split, limit, servable).instances]


def solve(
    instance: Instance, method: str, regime: str, case: Case | None = None, settings: Settings | None = None
) -> Solution:
    """Solve one instance in this process; a method's model is built once and used again.

    A policy or surrogate is read once: what replaces its file later is not seen in this process.

    Linear algebra runs in one thread, as in the commands: several slow these methods down.

    Args:
        instance: what to solve.
        method: one of ours, one that an installed package brings, or `module:function`.
        regime: one of the case's, such as `NO` or `TO`.
        case: needed if the instance's case is not a shipped one, or a changed copy of one.
        settings: a method's options, surrogate, policy, time limit and search folders; None: the default
            ones. Where it names no folders, models and policies are looked for in the default results
            folder, then in the reference run.

    Raises:
        InputError: unknown method, regime, settings or case, or a model or policy that is missing.
    """
    own = _case_of(instance, case)
    instance.check_case(own)
    return _prepared(own, method, regime, settings)(instance)


def simulate(
    instance: Instance,
    schedule: Schedule | pd.DataFrame,
    case: Case | None = None,
    plant: str | Plant | None = None,
) -> Trajectory:
    """Simulate a schedule on a plant; see `plants.plant.simulate`.

    Args:
        instance: its loads and its initial state.
        schedule: generator powers; arrays or nested lists, or a data frame with columns `t` and `P_<bus>`.
        case: needed if the instance's case is not a shipped one, or a changed copy of one.
        plant: its name, or a plant of the case; None: the case's own.

    Raises:
        InputError: the schedule does not span the horizon, or the case or plant is unknown.
        SimulationError: the plant cannot follow this schedule.
    """
    from ded_bench.plants import plant as plants
    from ded_bench.problem.schedule import as_schedule

    own = _case_of(instance, case)
    return plants.simulate(own, instance, as_schedule(schedule, own), plants.plant_of(own, plant))


def simulate_many(
    instances: Instance | Sequence[Instance],
    schedules: Sequence[Schedule | pd.DataFrame],
    case: Case | None = None,
    plant: str | Plant | None = None,
    threads: int | None = None,
) -> list[Trajectory | InputError | SimulationError]:
    """Simulate many schedules in threads of this process, each as `simulate` does it.

    A trajectory holds the plant's states at all points: what would fill the memory is given in portions.

    Args:
        instances: one for each schedule, or one for all.
        schedules: as for `simulate`.
        case: needed if the instances' case is not a shipped one.
        plant: as for `simulate`.
        threads: how many work at once; None: as many as there are cores.

    Returns:
        In the order of the schedules; in the place of one that cannot be simulated stands its error.

    Raises:
        InputError: there are not as many instances as schedules, or the case or plant is unknown.
    """
    from ded_bench.files.errors import InputError
    from ded_bench.plants.plant import in_threads, plant_of
    from ded_bench.problem.instance import Instance

    many = [instances] * len(schedules) if isinstance(instances, Instance) else list(instances)
    if len(many) != len(schedules):
        raise InputError("schedules", "", f"there are {len(schedules)} for {len(many)} instances")
    if not many:
        return []
    own = _case_of(many[0], case)
    chosen = plant_of(own, plant)
    return in_threads(lambda pair: simulate(*pair, own, chosen), zip(many, schedules, strict=True), threads)


def score(
    instance: Instance,
    schedule: Schedule | pd.DataFrame,
    regime: str,
    case: Case | None = None,
    plant: str | Plant | None = None,
) -> Score:
    """Simulate a schedule and judge it: cost and violations; see `plants.score.score`.

    Args:
        instance: its loads and its initial state.
        schedule: as for `simulate`.
        regime: one of the case's.
        case: needed if the instance's case is not a shipped one, or a changed copy of one.
        plant: as for `simulate`.

    Raises:
        InputError: unknown regime, or as for `simulate`.
        SimulationError: the plant cannot follow this schedule.
    """
    from ded_bench.plants import score
    from ded_bench.plants.plant import plant_of
    from ded_bench.problem.schedule import as_schedule

    own = _case_of(instance, case)
    return score.score(own, instance, as_schedule(schedule, own), regime, plant_of(own, plant))


def _case_of(instance: Instance, case: Case | None) -> Case:
    from ded_bench.files.errors import InputError

    if case is not None:
        if not hasattr(case, "generators"):
            raise InputError("case", "", f"must be a Case, such as Case.load({str(case)[:40]!r})")
        return case
    if (shipped := _shipped(instance.case)) is None:
        raise InputError(f"instance {instance.id}", "case", f"{instance.case!r} is no shipped case: give it")
    return shipped


@functools.cache
def _shipped(name: str) -> Case | None:
    from ded_bench.problem.case import SHIPPED_CASES, Case

    return Case.load(SHIPPED_CASES / name) if (SHIPPED_CASES / name / "case.json").is_file() else None


@functools.lru_cache(maxsize=8)
def _prepared(case: Case, method: str, regime: str, settings: Settings | None) -> Solver:
    from threadpoolctl import ThreadpoolController, threadpool_limits

    from ded_bench.methods.registry import get_method
    from ded_bench.methods.solution import Settings, Solution
    from ded_bench.plants.plant import SimulationError
    from ded_bench.results.folder import search_folders
    from ded_bench.solvers.status import Status

    chosen = settings or Settings()
    if not chosen.search:
        chosen = dataclasses.replace(chosen, search=search_folders(case))
    with threadpool_limits(1):
        solver = get_method(method).prepare(case, regime, chosen)
    libraries = ThreadpoolController()  # to find them takes milliseconds, a policy less than one

    def solve(instance: Instance) -> Solution:
        with libraries.limit(limits=1):
            try:
                return solver(instance)
            except SimulationError as error:  # the plant cannot begin so
                return Solution(Status.FAILED, error=str(error))

    return solve


if "gymnasium" in sys.modules:  # its users find the environments by their ids
    importlib.import_module("ded_bench.gym")
