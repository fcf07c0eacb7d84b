"""What really happens under a schedule: a plant, integrated over the grid of time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import Plant, PlantState, SimulationError, plant_of
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule, Trajectory

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def simulate(
    case: Case,
    instance: Instance,
    schedule: Schedule,
    plant: Plant | None = None,
    state: PlantState = None,
    exact: bool = True,
) -> Trajectory:
    """Integrate one instance under one schedule.

    Args:
        case: the grid.
        instance: its loads, and its state at t = 0 unless another is given.
        schedule: set-points.
        plant: what is simulated; None: the case's own.
        state: of the plant at t = 0; need not be an equilibrium.
        exact: see `Plant.advance`.

    Raises:
        SimulationError: the plant cannot follow the schedule.
        InputError: an instance is of another case, or a schedule does not span its horizon.
    """
    instance.check_case(case)
    schedule.check(instance.horizon_s)
    plant = plant or plant_of(case)
    p_set, p_load = schedule.at(instance.grid), instance.p_load(case)
    start = plant.initial(instance) if state is None else state
    piece = plant.advance(start, p_set, p_load, instance.dt_s, exact)
    # Sums over arrays of another order differ in the last bit.
    return Trajectory(
        t=instance.grid,
        omega=np.ascontiguousarray(piece.omega),
        p_set=p_set,
        p_gen=np.ascontiguousarray(piece.p_gen),
        p_load=p_load,
        p_slack=piece.p_slack,
        case=case,
        states=piece.states,
        columns=plant.columns(piece.states),
    )


def in_threads(
    function: Callable[[Item], Answer], items: Iterable[Item], threads: int | None = None
) -> list[Answer | InputError | SimulationError]:
    """What a function makes of each item, in their order, in threads; an item that fails becomes its error.

    Compiled plants let other threads work meanwhile.

    Args:
        function: of one item; what it raises beside the two errors is raised here.
        items: what it is called with.
        threads: how many work at once; None: as many as there are cores.
    """

    def answer(item: Item) -> Answer | InputError | SimulationError:
        try:
            return function(item)
        except (InputError, SimulationError) as error:
            return error

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return list(pool.map(answer, items))
