"""The second truth: a schedule on the full AC network, simulated and judged like on the lossless one."""

from __future__ import annotations

import functools

import numpy as np

from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.state import State
from ded_bench.truth.ac_integrator import integrate_ac
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.integrator import Inputs
from ded_bench.truth.network import PowerFlowError
from ded_bench.truth.score import Score, judge
from ded_bench.truth.simulate import METHOD, STEP_BY_MODE, SimulationError, Trajectory


def simulate_ac(
    case: Case, data: AcCase, instance: Instance, schedule: Schedule, state: State | None = None
) -> Trajectory:
    """Integrate one instance under one schedule; `truth.simulate.simulate` on the AC network.

    In the trajectory, angles of the case's generators are those of E', angles of other buses those of their
    voltages; the slack's power is that of its machine, which carries the losses.

    Args:
        case: the grid.
        data: its AC data.
        instance: its loads, and its state at t = 0 unless another is given.
        schedule: generator powers.
        state: where the generators are at t = 0; need not be an equilibrium.

    Raises:
        SimulationError: the network's equations have no solution at some time.
        InputError: an instance is of another case, a schedule does not span its horizon, or case and data
            do not fit together.
    """
    instance.check_case(case)
    schedule.check(instance.horizon_s)
    network = _network(case, data)
    p_gen, p_load = schedule.at(instance.grid), instance.p_load(case)
    active = network.active(p_load)
    try:
        first = network.initial_state(instance) if state is None else state
        point = network.operating_point(first.theta, active[0])
    except PowerFlowError as error:
        raise SimulationError(f"the system cannot follow this schedule: {error}") from None
    theta, omega = np.empty(p_gen.shape), np.empty(p_gen.shape)
    voltage = np.empty((len(p_gen), len(point.voltage)))
    power = np.empty((len(p_gen), network.n_machine))
    theta[0], omega[0], voltage[0] = first.theta, first.omega, point.voltage
    fastest = np.abs(network.modes(point)).max()
    steps = max(int(np.ceil(fastest * instance.dt_s / STEP_BY_MODE)), 1)
    inputs = Inputs(p_gen, active, instance.dt_s)
    try:
        done = integrate_ac(METHOD, network.grid, inputs, steps, theta, omega, voltage, power)
    except np.linalg.LinAlgError:
        done = 0
    if done < len(p_gen):
        raise SimulationError("the system cannot follow this schedule: the AC power flow has no solution")
    angles = network.bus_angles(theta, network.voltages(theta, voltage, active))
    return Trajectory(instance.grid, angles, omega, p_gen, p_load, power[:, -1].copy(), case)


def score_ac(case: Case, data: AcCase, instance: Instance, schedule: Schedule, regime: str) -> Score:
    """Simulate one schedule on the AC network and judge it.

    Raises:
        InputError: unknown regime, or as for `simulate_ac`.
        SimulationError: the network's equations have no solution at some time.
    """
    case.check_regimes([regime])
    return judge(case, instance, simulate_ac(case, data, instance, schedule), regime)


@functools.lru_cache(maxsize=4)
def _network(case: Case, data: AcCase) -> AcNetwork:
    return AcNetwork(case, data)
