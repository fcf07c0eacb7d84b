"""Plants: what is simulated, behind one protocol, and what they do under a schedule.

A new one is a folder and a line in PLANTS. A plant is a differential-algebraic system with a state,
set-points and loads as inputs, and outputs. Its state is opaque to all others; what a planner may know of it
is `observed`.
"""

from __future__ import annotations

import functools
import os
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ded_bench.files.errors import InputError
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance, State
from ded_bench.problem.schedule import Schedule, Trajectory

#: Only the plant that made it knows what is in it.
PlantState = Any


class SimulationError(ArithmeticError):
    """The plant cannot follow its set-points: its algebraic equations have no solution any more."""


@dataclass(frozen=True, eq=False)
class Piece:
    """What a plant does from one grid point of time to another, both included."""

    omega: Array  # (n, n_gen), rad/s, deviation from nominal
    p_gen: Array  # (n, n_gen), pu, delivered
    p_slack: Array  # (n,), pu
    states: Any  # at all points, for the plant's own use
    end: PlantState
    agc: Array | float = 0.0  # what secondary control asks of all machines together, (n,), pu


@dataclass(frozen=True, eq=False)
class NominalPoint:
    """The equilibrium of a case's nominal powers and loads."""

    p_slack: float | None  # pu; None on an island
    angle_deg: float  # largest angle across a line
    modes: NDArray[np.complex128]  # eigenvalues at it, 1/s


class Plant(Protocol):
    """A plant of one case: frozen, picklable.

    To simulate, judge and operate it takes `initial`, `advance` and `observed` without their optional
    arguments; under secondary control `columns`, too. Planning and drawing ask for the rest.
    """

    @property
    def name(self) -> str:
        """Its name in PLANTS."""

    @property
    def case(self) -> Case:
        """The grid."""

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with the plant's data."""

    def initial(self, instance: Instance, estimate: PlantState = None) -> PlantState:
        """The state at t = 0.

        Args:
            instance: what is measured of it.
            estimate: has all that a measurement does not give; None: that is stationary.

        Raises:
            SimulationError: there is none.
        """

    def advance(
        self, state: PlantState, p_set: Array, p_load: Array, dt_s: float, exact: bool = True
    ) -> Piece:
        """Integrate over the points of some inputs, which are linear between them.

        Args:
            state: at the first point.
            p_set: set-points at n ≥ 1 points, (n, n_gen), pu.
            p_load: load injections, (n, n_load), pu.
            dt_s: between points, s.
            exact: as the scorer needs it; else as a linearisation along it needs it, which is cheaper.

        Raises:
            SimulationError: the plant cannot follow.
        """

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TimeVarying:
        """Linearise along a trajectory of this plant.

        Args:
            trajectory: of `simulate`.
            points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        """

    def observed(self, state: PlantState) -> State:
        """What a planner is told of a state."""

    def columns(self, states: Any) -> Mapping[str, Array]:
        """What only this plant has, of `Piece.states`, as named columns of shape (n,)."""

    def check_servable(self, instance: Instance, source: str) -> None:
        """Raise InputError, which names source and field, unless static dispatch can serve it throughout."""

    def nominal(self) -> NominalPoint:
        """The equilibrium of nominal powers and loads.

        Raises:
            SimulationError: there is none.
        """

    def static_dispatch(self, instance: Instance, times: Array) -> Array:
        """Cheapest powers that serve the loads at some times, whatever frequencies do; (n, n_gen), pu.

        Args:
            instance: costs, loads, and powers at t = 0.
            times: ascending from 0, (n,), s. Where no slack takes what is missing, powers at 0 are those of
                the instance, and each is within the ramp limits from the one before.

        Raises:
            SimulationError: no powers within reach do.
        """

    def set_points_delivering(self, p_gen: Array, dt_s: float) -> Array:
        """Set-points that deliver given powers at rest and at nominal frequency, whatever ramps allow.

        Args:
            p_gen: on the grid of time, (n, n_gen), pu.
            dt_s: its step, s.
        """

    def check_followed(self, instance: Instance) -> None:
        """Raise SimulationError unless a servable instance that was drawn can follow static dispatch."""

    def balanced(self, instance: Instance) -> Instance:
        """A drawn instance with powers at t = 0 that are balanced, where no slack does that.

        Raises:
            SimulationError: there are none within limits.
        """


#: Plants by name: `module:class`, called with the case.
PLANTS: dict[str, str] = {
    "lossless": "ded_bench.plants.lossless.lossless_plant:LosslessPlant",
    "detailed": "ded_bench.plants.detailed.detailed_plant:DetailedPlant",
}


def plant_of(case: Case, given: str | Plant | None = None) -> Plant:
    """A plant of a case: the one given, or that of this name in PLANTS; None: the case's own.

    Raises:
        InputError: there is no such plant, or the case lacks its data.
    """
    if given is not None and not isinstance(given, str):
        return given
    name = given or case.plant_name
    if name not in PLANTS:
        raise InputError("plant", name[:40], f"is not one of {', '.join(PLANTS)}")
    return _made(case, name)


@functools.lru_cache(maxsize=16)
def _made(case: Case, name: str) -> Plant:
    plant: Plant = pkgutil.resolve_name(PLANTS[name])(case)
    return plant


def servable(case: Case, instance: Instance) -> Instance | None:
    """What becomes of a drawn instance: balanced where it must be; None: static dispatch cannot serve it."""
    plant = plant_of(case)
    try:
        instance = plant.balanced(instance)
        plant.check_servable(instance, "")
        plant.check_followed(instance)
    except (InputError, SimulationError):
        return None
    return instance


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
    cheaper = {} if exact else {"exact": False}
    piece = plant.advance(start, p_set, p_load, instance.dt_s, **cheaper)
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
        columns=plant.columns(piece.states) if hasattr(plant, "columns") else {},
    )


def copied(arrays: Any) -> Any:
    """A named tuple of arrays, perhaps of such tuples, with arrays of its own; None stays."""
    if isinstance(arrays, np.ndarray):
        return arrays.copy()
    return arrays and type(arrays)(*map(copied, arrays))


def in_threads(
    function: Callable[[Item], Answer], items: Iterable[Item], threads: int | None = None
) -> list[Answer | InputError | SimulationError]:
    """What a function makes of each item, in their order, in threads; an item that fails becomes its error.

    Compiled plants let other threads work meanwhile; linear algebra has no threads beside these.

    Args:
        function: of one item; what it raises beside the two errors is raised here.
        items: what it is called with.
        threads: how many work at once; None: as many as there are cores.

    Raises:
        InputError: no thread is to work.
    """
    if threads is not None and threads < 1:
        raise InputError("threads", "", f"must be at least 1, or None for all cores, not {threads}")

    def answer(item: Item) -> Answer | InputError | SimulationError:
        try:
            return function(item)
        except (InputError, SimulationError) as error:
            return error

    with threadpool_limits(1), ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return list(pool.map(answer, items))
