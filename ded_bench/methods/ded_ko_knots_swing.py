"""DED-KO on the case's knots, on swing equations that were identified from AC trajectories.

The linear program stands along a simulation of the identified model, first under the static dispatch, then
under the program's own answer: where the dispatch is far from what the bound allows, or cannot be simulated,
one linearisation is not enough. No equation of a network is used, and no answer is simulated on one.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.koopman.identified_swing import KIND, IdentifiedSwing
from ded_bench.koopman.surrogates import model_file
from ded_bench.koopman.trajectory import TrajectoryModel
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.knot_program import knot_points
from ded_bench.methods.solution import DEFAULT_MODEL, Settings, Solution
from ded_bench.methods.surrogate_program import solve_along
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.simulate import SimulationError

#: Linearisations of one instance: along the static dispatch, then along the last program's answer.
SETTINGS: Mapping[str, Mapping[str, Any]] = {"swing-ac": {"rounds": 3}, "swing-ac-once": {"rounds": 1}}


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The model that `prepare` would use."""
    path = _file(case, settings)
    return (Artifact("model", KIND, IdentifiedSwing.load(path, case).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> SwingSolver:
    """Return a solver of single instances on the identified model: a file, or that of the results folders."""
    case.check_regimes([regime])
    model = IdentifiedSwing.load(_file(case, settings), case)
    return SwingSolver(case, model, regime, SETTINGS[settings.name]["rounds"], settings.time_limit_s)


def _file(case: Case, settings: Settings) -> Path:
    """Where the model lies.

    Raises:
        InputError: nowhere (names the command that makes it).
    """
    if settings.model != DEFAULT_MODEL:
        return Path(settings.model)
    for folder in settings.search:
        if model_file(folder, KIND).is_file():
            return model_file(folder, KIND)
    command = f"ded-bench train-ko --case {case.id} --truth ac --kind swing"
    raise InputError(
        "--settings", settings.name, f"needs a model that is not identified yet; run `{command}`"
    )


@dataclass(frozen=True)
class SwingSolver:
    """Solves instances of one case and regime on one identified model."""

    case: Case
    model: IdentifiedSwing
    regime: str
    rounds: int
    time_limit_s: float | None = None

    def __call__(self, instance: Instance) -> Solution:
        """Solve."""
        return self._solution(instance, soft=False)

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, is what to linearise along at first.
        """
        return self._solution(instance, True, None if last is None else last.schedule)

    def _solution(self, instance: Instance, soft: bool, near: Schedule | None = None) -> Solution:
        found = None
        for _ in range(self.rounds if near is None else 1):
            new = self._around(instance, soft, near, must=found is None)
            if new is None or (found is not None and new.schedule is None):
                break
            found = new if found is None else _with_effort(new, found)
            near = found.schedule
            if near is None:
                break
        assert found is not None
        return found

    def _around(self, instance: Instance, soft: bool, near: Schedule | None, must: bool) -> Solution | None:
        """The program along one simulation: that of a schedule, or of the first one that can be simulated.

        Args:
            near: the schedule, if there is one already.
            must: go on without it where it cannot be simulated; else the answer is None.
        """
        started = time.perf_counter()
        points = knot_points(self.case.knot_times(instance.horizon_s), instance.dt_s)

        def along(p_gen: Array) -> TrajectoryModel:
            trajectory = self.model.simulate(instance, Schedule(t=instance.grid[points], p=p_gen))
            return self.model.linearise_along(trajectory, points)

        make: Callable[[Array], TrajectoryModel] = along
        spent = 0.0
        if near is not None:
            powers = near.at(instance.grid[points])
            powers[0] = instance.p_initial(self.case)
            try:
                model = along(powers)
            except SimulationError:
                if not must:
                    return None
            else:
                make, spent = (lambda _: model), time.perf_counter() - started
        solution = solve_along(self.case, instance, self.regime, points, make, self.time_limit_s, soft)
        return dataclasses.replace(solution, build_s=(solution.build_s or 0.0) + spent)


def _with_effort(answer: Solution, earlier: Solution) -> Solution:
    """An answer with the time and iterations of the one before."""
    return dataclasses.replace(
        answer,
        iterations=(answer.iterations or 0) + (earlier.iterations or 0),
        build_s=(answer.build_s or 0.0) + (earlier.build_s or 0.0),
        solve_s=(answer.solve_s or 0.0) + (earlier.solve_s or 0.0),
    )
