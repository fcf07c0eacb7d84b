"""The grid while time goes on: the true swing DAE, advanced piece by piece."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ded_bench.plants.lossless.integrator import Inputs, integrate
from ded_bench.plants.lossless.network import Network, PowerFlowError
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.simulate import METHOD, STEP_BY_MODE
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import State
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Piece:
    """What the grid does from one grid point of time to another, both included."""

    theta: Array  # (n, n_bus), rad
    omega: Array  # (n, n_gen), rad/s
    p_slack: Array  # (n,), pu


class Grid(Protocol):
    """What advances a scenario: `Plant`, or the same on another network."""

    theta: Array  # at t = 0, of all buses, (n_bus,), rad
    omega: Array  # likewise, of the generators, (n_gen,), rad/s

    def advance(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> Piece:
        """Integrate over the points of some powers."""
        ...

    def measured(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> State:
        """What a method is told of a state."""
        ...


class Plant:
    """The grid of a scenario, which starts from the power flow; steps are as short as `simulate`'s.

    Raises:
        SimulationError: there is no such power flow.
    """

    def __init__(self, case: Case, scenario: Scenario) -> None:
        self.network = Network(case)
        self._dt = scenario.dt_s
        first = scenario.snapshot(case, 0.0)
        try:
            self.theta = self.network.initial_angles(first)
        except PowerFlowError as error:
            raise SimulationError(f"the scenario has no initial power flow: {error}") from None
        self.omega = first.omega_initial(case)
        fastest = np.abs(self.network.linearise(self.theta).modes()).max()
        self._steps = max(int(np.ceil(fastest * self._dt / STEP_BY_MODE)), 1)

    def advance(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> Piece:
        """Integrate over the points of some powers.

        Args:
            theta: angles of all buses at the first point, (n_bus,), rad.
            omega: frequency deviations there, (n_gen,), rad/s.
            p_gen: powers at n ≥ 1 points, (n, n_gen), pu.
            p_load: loads, (n, n_load), pu.

        Raises:
            SimulationError: the system loses synchronism.
        """
        angles, speeds = np.empty((len(p_gen), len(theta))), np.empty(p_gen.shape)
        angles[0], speeds[0], p_slack = theta, omega, np.empty(len(p_gen))
        inputs = Inputs(np.ascontiguousarray(p_gen), self.network.load_injections(p_load), self._dt)
        try:
            done = integrate(METHOD, self.network.grid, inputs, self._steps, angles, speeds, p_slack)
        except np.linalg.LinAlgError:
            done = 0
        if done < len(p_gen):
            raise SimulationError("the system cannot follow these powers: the power flow has no solution")
        return Piece(angles, speeds, p_slack)

    def measured(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> State:
        """What a method is told of a state.

        Args:
            theta: angles of all buses, (n_bus,), rad.
            omega: (n_gen,), rad/s.
            p_gen: (n_gen,), pu.
            p_load: (n_load,), pu.
        """
        return State(theta[self.network.generators], omega, p_gen)


class Record:
    """What has happened since t = 0; grows piece by piece."""

    def __init__(self, case: Case, scenario: Scenario, plant: Grid) -> None:
        n = scenario.steps + 1
        self.case, self.scenario, self.now = case, scenario, 0
        self.p_load = scenario.p_load(case)
        self.theta, self.omega = np.empty((n, len(plant.theta))), np.empty((n, len(plant.omega)))
        self.p_gen, self.p_slack = np.empty(self.omega.shape), np.empty(n)
        self.theta[0], self.omega[0] = plant.theta, plant.omega
        self.p_gen[0] = [scenario.initial.power[bus] for bus in case.generators]
        self._plant = plant

    def advance(self, p_gen: Array) -> None:
        """Go on under powers at the present point and those after it, shape (n, n_gen), pu."""
        k = slice(self.now, self.now + len(p_gen))
        piece = self._plant.advance(self.theta[self.now], self.omega[self.now], p_gen, self.p_load[k])
        self.theta[k], self.omega[k], self.p_slack[k] = piece.theta, piece.omega, piece.p_slack
        self.p_gen[k] = p_gen
        self.now += len(p_gen) - 1

    def state(self) -> State:
        """What is measured now."""
        k = self.now
        return self._plant.measured(self.theta[k], self.omega[k], self.p_gen[k], self.p_load[k])

    def predicted(self, p_gen: Array, p_load: Array) -> State:
        """The state at the end of some powers and forecast loads from now on; raises as `Plant.advance`."""
        piece = self._plant.advance(self.theta[self.now], self.omega[self.now], p_gen, p_load)
        return self._plant.measured(piece.theta[-1], piece.omega[-1], p_gen[-1], p_load[-1])

    def trajectory(self) -> Trajectory:
        """All of it."""
        grid = self.scenario.grid
        return Trajectory(grid, self.theta, self.omega, self.p_gen, self.p_load, self.p_slack, self.case)
