"""The swing equations on the full AC network, linearised along a simulated trajectory."""

from __future__ import annotations

import numpy as np

from ded_bench.koopman.trajectory import Indices, TrajectoryModel, time_varying
from ded_bench.problem.case import Case
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.simulate import Trajectory


def linearise_along_ac(network: AcNetwork, trajectory: Trajectory, points: Indices) -> TrajectoryModel:
    """`trajectory.linearise_along` on the AC network.

    Between two knots the stiffness is that of the middle of the interval. It is not symmetric, since lines
    have losses; the slack's machine has a row of its own.

    Args:
        network: the AC network of the trajectory's case.
        trajectory: what `truth.ac_simulate` says about one schedule.
        points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).

    Raises:
        PowerFlowError: the trajectory is not one of this network.
    """
    case = trajectory.case
    generators = _generators(case)
    active = network.active(trajectory.p_load)
    stiffness, voltage = [], None
    for k in (points[:-1] + points[1:]) // 2:
        point = network.operating_point(trajectory.theta[k][generators], active[k], voltage)
        voltage = point.voltage  # where Newton's method starts at the next interval
        stiffness.append(network.linearise(point).stiffness)
    whole = np.stack(stiffness)
    return time_varying(trajectory, points, whole[:, :-1], whole[:, -1], network.m, network.d)


def _generators(case: Case) -> Indices:
    place = {bus.id: i for i, bus in enumerate(case.buses)}
    return np.array([place[bus] for bus in case.generators])
