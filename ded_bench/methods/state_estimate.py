"""What a measurement does not give, in operation: fluxes, exciters, valves; from a simulation of the plan.

A planner that is asked again and again knows the plan that it gave, and what it planned it for. Its own
simulation of that plan, from its own estimate then, has all states of the plant; what is measured replaces
what it has of that. So with a forecast that comes true the estimate is the plant's state.
"""

from __future__ import annotations

import numpy as np

from ded_bench.plants.plant import Plant, PlantState, SimulationError
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: A plan in force that differs by more from the last one given is another, pu.
SAME = 1e-6


def passed_s(instance: Instance, in_force: Schedule | None, given: Schedule) -> float | None:
    """How long ago the plan in force was given, s; None if it is another one.

    Args:
        instance: has the horizon of both.
        in_force: the plan in force, on the time of the instance.
        given: the plan, on its own time.
    """
    if in_force is None or len(in_force.t) < 3:
        return None
    # The end of the plan in force lies before the last time.
    passed, ahead = instance.horizon_s - float(in_force.t[-2]), in_force.t[:-1]
    if not 0 < round(passed / instance.dt_s) <= instance.steps:
        return None
    return passed if np.abs(given.at(ahead + passed) - in_force.p[:-1]).max() <= SAME else None


class StateEstimate:
    """Estimates of one plant's states, from plan to plan.

    Args:
        plant: what plans are made for.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        #: A plan, and what it was made for.
        self._given: tuple[Instance, PlantState, Schedule] | None = None

    def initial(self, instance: Instance, in_force: Schedule | None) -> PlantState:
        """The state at t = 0.

        Args:
            instance: what is measured.
            in_force: the plan in force, on the time of the instance.

        Raises:
            SimulationError: see `Plant.initial`.
        """
        return self._plant.initial(instance, self._ahead(in_force))

    def keep(self, instance: Instance, state: PlantState, schedule: Schedule | None) -> None:
        """Remember the plan that was given for an instance and a state; without one the last goes on."""
        if schedule is not None:
            self._given = instance, state, schedule

    def _ahead(self, in_force: Schedule | None) -> PlantState:
        """What the last plan has led to at the instance's t = 0; None if another one is in force."""
        if self._given is None:
            return None
        instance, state, schedule = self._given
        passed = passed_s(instance, in_force, schedule)
        if passed is None:
            return None
        grid = instance.grid[: round(passed / instance.dt_s) + 1]
        p_load = instance.p_load(self._plant.case, grid)
        try:
            return self._plant.advance(state, schedule.at(grid), p_load, instance.dt_s, exact=False).end
        except SimulationError:
            return None
