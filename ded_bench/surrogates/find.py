"""The surrogates by name, and where trained ones lie."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import Plant, PlantState, plant_of, simulate
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance, LoadPoints, State
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import ResultsFolder
from ded_bench.surrogates.koopman import Koopman

if TYPE_CHECKING:
    from ded_bench.plants.detailed.coarse import CoarsePlant
    from ded_bench.plants.detailed.detailed_plant import DetailedPlant

#: Models that `ded-bench train-ko` identifies.
TRAINED = ("koopman", "koopman-paper")
#: The linearisation along a simulated trajectory.
TRAJECTORY = "trajectory"
#: All models by name; those not trained follow from the case, or from each instance.
MODELS = (*TRAINED, "linear", TRAJECTORY)


@dataclass(frozen=True)
class AlongTrajectory:
    """The surrogate that is made anew for each instance: nothing of it is trained."""

    plant: Plant
    kind: str = TRAJECTORY

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with the plant."""
        return hashlib.sha256(f"{self.kind}|{self.plant.fingerprint}".encode()).hexdigest()[:12]

    def along(
        self, instance: Instance, p_gen: Array, points: Indices, exact: bool = True, state: PlantState = None
    ) -> TimeVarying:
        """The plant linearised along the simulation of powers at the knots; see `Koopman.along`.

        Args, but for those there:
            exact: see `Plant.advance`.
            state: of the plant at t = 0; None: the instance's.

        Raises:
            SimulationError: the system cannot follow these powers.
        """
        schedule = Schedule(t=instance.grid[points], p=p_gen)
        run = simulate(self.plant.case, instance, schedule, self.plant, state, exact)
        return self.plant.linearise_along(run, points)


@dataclass(frozen=True)
class AtNominalPoint(AlongTrajectory):
    """`linear` on an island: the Jacobian at the nominal point, and rates of an instance's own start.

    Secondary control acts on it as on the plant.
    """

    plant: DetailedPlant
    kind: str = "linear"
    _made: dict[Hashable, TimeVarying] = field(default_factory=dict, compare=False, repr=False)
    _coarse: dict[float, CoarsePlant] = field(default_factory=dict, compare=False, repr=False)

    def along(
        self, instance: Instance, p_gen: Array, points: Indices, exact: bool = True, state: PlantState = None
    ) -> TimeVarying:
        """See `AlongTrajectory.along`; what is followed is the linear model itself."""
        from ded_bench.plants.detailed.coarse import CoarsePlant  # and with it Numba

        start = self.plant.initial(instance) if state is None else state
        key = points.tobytes(), instance.dt_s, start.next_s
        if key not in self._made:
            self._made[key] = self._at_rest(instance, points, start.next_s)
        model, dt_s = self._made[key], instance.dt_s
        coarse = self._coarse.setdefault(dt_s, CoarsePlant(self.plant.system, dt_s))
        p_set = Schedule(instance.grid[points], p_gen).at(instance.grid)
        omega, delivered = coarse.follow(coarse.begin(instance, start), p_set, linear=True)
        assert model.delivered is not None
        return replace(model, omega=omega, p_gen=p_gen, delivered=model.delivered._replace(p_gen=delivered))

    def _at_rest(self, instance: Instance, points: Indices, next_s: float) -> TimeVarying:
        """Maps of set-points along the nominal equilibrium."""
        case, system = self.plant.case, self.plant.system
        power = system.network.nominal().power.real[system.scheduled]
        nominal = zip(case.loads, (-system.network.p_drawn[system.load_ports]).tolist(), strict=True)
        load = {bus: LoadPoints(points=np.array([[0.0, p], [instance.horizon_s, p]])) for bus, p in nominal}
        initial = State(None, np.zeros(len(power)), power).initial(case)
        rest = instance.model_copy(update={"initial": initial, "load": load})
        state = self.plant.initial(rest)._replace(next_s=next_s)
        schedule = Schedule(instance.grid[[0, -1]], np.stack([power, power]))
        return self.plant.linearise_along(simulate(case, rest, schedule, self.plant, state), points)


#: A lifted model has one K for all instances and times; the other kind is made for each instance.
Surrogate = Koopman | AlongTrajectory


def find_surrogate(case: Case, name: str, search: Sequence[Path], usual: str = "koopman") -> Surrogate:
    """Return a surrogate by its kind, from the first folder that has it, or by its file's path.

    No name means the usual one, and `trajectory` on plants whose usual one nobody identifies.

    Raises:
        InputError: there is no such model yet (names the command that makes it), its file is wrong, or there
            is none of this kind on the case's plant.
    """
    name = name or (usual if case.plant_name == "lossless" else TRAJECTORY)
    if name == TRAJECTORY:
        return AlongTrajectory(plant_of(case))
    if name == "linear" and case.plant_name == "detailed" and case.slack is None:
        return AtNominalPoint(plant_of(case))  # type: ignore[arg-type]
    if name in MODELS and case.plant_name != "lossless":
        known = f"linear or {TRAJECTORY}" if case.slack is None else TRAJECTORY
        problem = f"there is none of case {case.id}, whose plant is {case.plant_name}; use {known}"
        raise InputError("--model", name, problem)
    if name == "linear":
        from ded_bench.surrogates.linear import linear_model  # with SciPy, which most commands do without

        return linear_model(case)
    files, problem = [Path(name)], f"no such file and no such model (known: {', '.join(MODELS)})"
    if name in TRAINED:
        files = [ResultsFolder(folder).model(name) for folder in search]
        problem = f"not there yet; run `ded-bench train-ko --case {case.place}`, or use --model {TRAJECTORY}"
    for file in files:
        if file.is_file():
            return Koopman.load(file, case)
    raise InputError("--model", name, problem)


def find_model(case: Case, name: str, search: Sequence[Path]) -> Koopman:
    """Return a lifted model, as `find_surrogate` does.

    Raises:
        InputError: as there, or the surrogate of this name is made for each instance.
    """
    found = find_surrogate(case, name, search)
    if isinstance(found, Koopman):
        return found
    raise InputError("--model", name, "has no K for all instances; `ded-ko` and `ded-ko-knots` know it")
