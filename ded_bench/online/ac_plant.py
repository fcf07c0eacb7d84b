"""The full AC network while time goes on, advanced piece by piece like the lossless one."""

from __future__ import annotations

import numpy as np

from ded_bench.online.plant import Piece
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Array, Case
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.state import State
from ded_bench.truth.ac_integrator import integrate_ac
from ded_bench.truth.ac_network import AcNetwork, OperatingPoint
from ded_bench.truth.integrator import Inputs
from ded_bench.truth.network import Network, PowerFlowError
from ded_bench.truth.simulate import METHOD, STEP_BY_MODE, SimulationError


class AcPlant:
    """The AC network of a scenario, which starts from its equilibrium; steps as short as `simulate_ac`'s.

    Angles are known of the generators' E' only; those of other buses are NaN. A method that plans on the
    lossless network gets the angles at which that network delivers the measured electrical powers: with those
    of E' its model would start far from rest.

    Raises:
        SimulationError: there is no such equilibrium.
    """

    def __init__(self, case: Case, scenario: Scenario, data: AcCase, lossless_angles: bool) -> None:
        self._network = AcNetwork(case, data)
        self._lossless = Network(case)
        self._dt = scenario.dt_s
        self._translated = lossless_angles
        self._generators = self._lossless.generators
        first = scenario.snapshot(case, 0.0)
        self.theta = np.full(len(case.buses), np.nan)
        self.omega = first.omega_initial(case)
        active = self._network.active(first.p_load(case, np.zeros(1)))[0]
        try:
            state = self._network.initial_state(first)
            point = self._network.operating_point(state.theta, active)
        except PowerFlowError as error:
            raise SimulationError(f"the scenario has no initial AC equilibrium: {error}") from None
        self.theta[self._generators] = state.theta
        fastest = np.abs(self._network.modes(point)).max()
        self._steps = max(int(np.ceil(fastest * self._dt / STEP_BY_MODE)), 1)

    def advance(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> Piece:
        """Integrate over the points of some powers; as `Plant.advance`."""
        network, n = self._network, len(p_gen)
        active = network.active(p_load)
        point = self._point(theta, active[0])
        angles, speeds = np.empty(p_gen.shape), np.empty(p_gen.shape)
        angles[0], speeds[0] = point.theta, omega
        voltage, power = np.empty((n, len(point.voltage))), np.empty((n, network.n_machine))
        voltage[0] = point.voltage
        inputs = Inputs(np.ascontiguousarray(p_gen), active, self._dt)
        try:
            done = integrate_ac(METHOD, network.grid, inputs, self._steps, angles, speeds, voltage, power)
        except np.linalg.LinAlgError:
            done = 0
        if done < n:
            raise SimulationError("the system cannot follow these powers: the AC power flow has no solution")
        everywhere = np.full((n, len(theta)), np.nan)
        everywhere[:, self._generators] = angles
        return Piece(everywhere, speeds, power[:, -1].copy())

    def measured(self, theta: Array, omega: Array, p_gen: Array, p_load: Array) -> State:
        """What a method is told of a state; as `Plant.measured`.

        Raises:
            SimulationError: the lossless network cannot deliver the electrical powers of this state.
        """
        angles = theta[self._generators]
        if self._translated:
            power = self._point(theta, self._network.active(p_load)).power[:-1]
            try:
                angles = self._lossless.power_flow(power, p_load)[self._generators]
            except PowerFlowError as error:
                raise SimulationError(f"the lossless network has no such state: {error}") from None
        return State(angles, omega, p_gen)

    def _point(self, theta: Array, active: Array) -> OperatingPoint:
        try:
            return self._network.operating_point(theta[self._generators], active)
        except PowerFlowError as error:
            raise SimulationError(f"the system cannot follow these powers: {error}") from None
