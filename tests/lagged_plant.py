"""A second plant: the lossless grid behind first-order turbines, whose delivered powers follow set-points.

    dp/dt = (p_set - p) / T,    p the mechanical power of the lossless network's machines

Set-points are linear between grid points, where p is exact; between them the network sees p linear.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from ded_bench.plants.hold import Hold, across_intervals, doubled
from ded_bench.plants.lossless.lossless_plant import LosslessPlant, LosslessState
from ded_bench.plants.plant import PLANTS, Piece
from ded_bench.plants.time_varying import Delivered, TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance, State
from ded_bench.problem.lossless_case import LosslessCase
from ded_bench.problem.schedule import Trajectory

#: Time constant of the turbines, s.
LAG_S = 0.3


class LaggedCase(LosslessCase):
    """A case that is simulated on the lagged plant."""

    @property
    def plant_name(self) -> str:
        return "lagged"


def lagged_case(case: Case) -> LaggedCase:
    return LaggedCase.model_validate(case.model_dump(by_alias=True))


@pytest.fixture
def lagged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant is registered: a line."""
    monkeypatch.setitem(PLANTS, "lagged", "tests.lagged_plant:LaggedPlant")


class LaggedState(NamedTuple):
    """Where the grid is, and the set-points."""

    grid: LosslessState  # with the delivered powers
    p_set: Array


@dataclass(frozen=True)
class LaggedPlant:
    """See `ded_bench.plants.plant.Plant`."""

    case: Case
    name: str = "lagged"

    @property
    def network(self) -> LosslessPlant:
        return LosslessPlant(self.case)

    @property
    def fingerprint(self) -> str:
        return hashlib.sha256(f"{self.case.fingerprint}|{LAG_S}".encode()).hexdigest()[:12]

    def initial(self, instance: Instance) -> LaggedState:
        grid = self.network.initial(instance)
        return LaggedState(grid, grid.p_gen)

    def advance(
        self, state: LaggedState, p_set: Array, p_load: Array, dt_s: float, exact: bool = True
    ) -> Piece:
        kept, on_end = _weights(dt_s)
        p_gen = np.empty_like(p_set)
        p_gen[0] = state.grid.p_gen
        for k, change in enumerate(np.diff(p_set, axis=0)):
            p_gen[k + 1] = kept * p_gen[k] + (1.0 - kept) * p_set[k] + on_end * change
        piece = self.network.advance(state.grid, p_gen, p_load, dt_s, exact)
        return dataclasses.replace(piece, end=LaggedState(piece.end, p_set[-1]))

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TimeVarying:
        """States are those of the network, then the deviations of the delivered powers."""
        kept, on_end = _weights(float(trajectory.t[1] - trajectory.t[0]))
        model = self.network.linearise_along(trajectory, points)
        n_maps, n_state, n_gen = model.step.g.shape
        f, (g, h) = (
            np.zeros((n_maps, n_state + n_gen, n_state + n_gen)),
            np.zeros((2, n_maps, n_state + n_gen, n_gen)),
        )
        eye = np.eye(n_gen)
        f[:, :n_state, :n_state] = model.step.f
        f[:, :n_state, n_state:] = model.step.g - (1.0 - kept) * model.step.h
        f[:, n_state:, n_state:] = kept * eye
        g[:, :n_state], g[:, n_state:] = (1.0 - kept) * model.step.h, (1.0 - kept) * eye
        h[:, :n_state], h[:, n_state:] = on_end * model.step.h, on_end * eye
        step, n = Hold(f, g, h), len(model.lengths)
        c_p = np.zeros((n, n_gen, n_state + n_gen))
        c_p[:, :, n_state:] = eye
        return dataclasses.replace(
            model,
            step=step,
            across=across_intervals(doubled(step, model.lengths), model.lengths),
            slack=np.concatenate([model.slack, np.zeros((n, n_gen))], axis=1),
            delivered=Delivered(c_p, np.zeros((n, n_gen, n_gen)), trajectory.p_gen),
        )

    def observed(self, state: LaggedState) -> State:
        """A planner's P_0 are the set-points: schedules go on from there."""
        return self.network.observed(state.grid._replace(p_gen=state.p_set))

    def columns(self, states: Any) -> Mapping[str, Array]:
        return self.network.columns(states)

    def static_dispatch(self, instance: Instance, times: Array) -> Array:
        return self.network.static_dispatch(instance, times)

    def check_followed(self, instance: Instance) -> None:
        self.network.check_followed(instance)

    def balanced(self, instance: Instance) -> Instance:
        return instance

    def check_servable(self, instance: Instance, source: str) -> None:
        self.network.check_servable(instance, source)


def _weights(dt_s: float) -> tuple[float, float]:
    """What is kept of p over a step, and how much of a change of the set-point over it arrives."""
    kept = float(np.exp(-dt_s / LAG_S))
    return kept, 1.0 - LAG_S / dt_s * (1.0 - kept)
