"""DED-KO on knots for repeated solution: the settings `receding` of `ded-ko-knots`.

A plan is followed for a second, then the next one replaces it. Two things differ from a single solution:

* **Knots keep their places in time.** If every plan had its first knot as long after its own start, what the
  last plan would go on to do is linear between other knots, so that it is no solution of the new program;
  where it rides on the frequency bound, the new program may have no solution that keeps it.
* **Plans keep a margin below the bound** for loads that nobody announced.

A single instance, outside of operation, is solved as by the default settings.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.knots import knot_points
from ded_bench.methods.model_artifact import model_artifact
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import solve_on_surrogate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.surrogates.find import Surrogate, find_surrogate
from ded_bench.plants.time_varying import Indices

#: Part of the frequency bound that plans leave free.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "receding": {"margin": 1 / 16},
    "receding-wide": {"margin": 0.25},
}
#: In operation only they differ from these settings, so that `bench` need not time them.
TIMED_AS: Mapping[str, str] = dict.fromkeys(SETTINGS, "default")


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The surrogate that `prepare` would use."""
    return (model_artifact(case, settings),)


def prepare(case: Case, regime: str, settings: Settings) -> RecedingSolver:
    """Return a solver that may be told the plan in force."""
    case.check_regimes([regime])
    surrogate = find_surrogate(case, settings.model, settings.search)
    return RecedingSolver(case, surrogate, regime, settings.time_limit_s, **SETTINGS[settings.name])


@dataclass(frozen=True)
class RecedingSolver:
    """Solves instances of one case and regime on one surrogate."""

    case: Case
    surrogate: Surrogate
    regime: str
    time_limit_s: float | None = None
    margin: float = 0.0  # part of the bound

    def __call__(self, instance: Instance) -> Solution:
        """Solve with the case's knots and bound."""
        return self._solution(self.case, instance, None, soft=False)

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve in operation: `Infeasible` comes with the schedule of least frequency excess.

        Args:
            instance: what to solve.
            last: its schedule, if it has one, gives the knots; its time is the instance's.
        """
        near = None if last is None else last.schedule
        return self._solution(self._planning_case, instance, near, soft=True)

    @functools.cached_property
    def _planning_case(self) -> Case:
        return tightened(self.case, self.margin)

    def _solution(self, case: Case, instance: Instance, last: Schedule | None, soft: bool) -> Solution:
        points = receding_points(case, instance, last)
        return solve_on_surrogate(
            case, self.surrogate, instance, self.regime, points, self.time_limit_s, soft
        )


def tightened(case: Case, margin: float) -> Case:
    """A case whose frequency bounds are smaller by a part of them."""
    regimes = {
        name: limits.model_copy(update={"omega_hz": (1 - margin) * limits.omega_hz})
        for name, limits in case.regimes.items()
    }
    return case.model_copy(update={"regimes": regimes})


def receding_points(case: Case, instance: Instance, last: Schedule | None) -> Indices:
    """Grid points of knots: those of the plan in force that lie ahead, and more at the end.

    Args:
        case: gives the distance of knots.
        instance: gives the grid.
        last: the plan in force, on the time of the instance. What has fewer knots than a horizon has, or
            others closer together than the case's, gives none.

    Returns:
        Strictly increasing from 0 to the last grid point, shape (n_knots,).
    """
    times = case.knot_times(instance.horizon_s)
    distance = times[1] - times[0]
    if last is None:
        return knot_points(times, instance.dt_s)
    # The last two points are the end of the plan in force, which no knot has, and the horizon.
    ahead = last.t[1:-2]
    if len(ahead) < 2 or np.diff(ahead).min() < distance / 2:
        return knot_points(times, instance.dt_s)
    beyond = np.arange(ahead[-1] + distance, instance.horizon_s - distance / 2, distance)
    return knot_points(np.concatenate([[0.0], ahead, beyond, [instance.horizon_s]]), instance.dt_s)
