"""The grid along the path of a problem: start schedule, linearisation, response."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.admm.drawn_problems import Problems, averaged
from ded_bench.methods.admm.elimination import plan_elimination
from ded_bench.methods.admm.grid_response import FINE, GridResponse
from ded_bench.methods.admm.iteration_kernels import swing
from ded_bench.methods.admm.iteration_records import SMALLEST_COST
from ded_bench.methods.admm.path_kernels import Lines, follow_path, path_inputs, start_angles
from ded_bench.methods.admm.start_kernels import first_schedules
from ded_bench.problem.case import Array, Case

#: Part of the bound on |ω| at which angles move in the start schedule.
START_RATE = 0.9


@dataclass(frozen=True, eq=False)
class Outset:
    """What is known of problems before any decision."""

    problems: Problems
    served: NDArray[np.bool_]  # whether there is a power flow, (batch,)
    theta: Array  # equilibrium angles at t = 0, (batch, n_bus), rad
    state: Array  # modes at t = 0, (batch, 2, n_modes)
    fixed: Array  # T (L - L_0) at the fine points, (batch, n_fine, n_gen), pu
    scale: Array  # what costs are relative to: mean cost of the ramp-limited dispatch, (batch,)
    start: Array  # first schedule, (batch, n_knots, n_gen), pu


@dataclass(frozen=True, eq=False)
class Linear:
    """The grid linearised along a path: what is not P in the modes' inputs, and how stiffness changes."""

    offset: Array  # of -T (L - L_0) - r + ΔS x_ref less P_0 at the fine points, (batch, n_fine, n_modes)
    change: Array  # ΔS of the modes at the instants, (batch, n_instants, n_modes, n_modes), 1/s²
    slack: Array  # P_s at x = 0, at the fine points, (batch, n_fine), pu
    stiffness: Array  # ΔS at the instants, (batch, n_instants, n_gen, n_gen), pu/rad


class PathModel:
    """The grid along the paths of problems, for one case and bound."""

    def __init__(self, case: Case, bound: float, response: GridResponse) -> None:
        network = response.network
        self.case, self.bound, self.response, self.network = case, bound, response, network
        self.lines = Lines(network.ends, network.coupling, network.generators, network.loads)
        slack, machines = [network.slack], [network.slack, *network.generators.tolist()]
        self.to_slack, self.to_machines = (
            plan_elimination(network.ends, network.n_bus, kept) for kept in (slack, machines)
        )
        self.spacing = float(response.knots[1] - response.knots[0])
        self.ramp = case.ramp * self.spacing
        self.modes = response.modes
        self.inverse = np.linalg.inv(response.shape)
        self.mass = network.m / network.m.mean()
        at = response.instants
        #: Linear interpolation from the instants to the fine points, and their shares of a mean over time.
        self.between = np.stack(
            [np.interp(response.fine, response.knots[at], row) for row in np.eye(len(at))], axis=1
        )
        self.shares = np.trapezoid(self.between, response.fine, axis=0) / response.fine[-1]

    def outset(self, problems: Problems) -> Outset:
        """Angles at t = 0 and the first schedule."""
        response, network, batch = self.response, self.network, len(problems)
        theta, served = np.empty((batch, network.n_bus)), np.empty(batch, bool)
        wanted = np.zeros((batch, network.n_bus))
        wanted[:, network.generators] = problems.p_initial
        wanted[:, network.loads] = problems.load[:, 0]
        for b in range(batch):
            served[b] = start_angles(self.lines, self.to_slack, response.theta, wanted[b], theta[b])
        fixed = (problems.load - problems.load[:, :1]) @ response.share.T
        state = np.stack([problems.delta @ self.inverse, problems.omega @ self.inverse], axis=1)
        n_knots, n_gen = len(response.knots), len(response.gain)
        mean_cost, start = np.empty(batch), np.empty((batch, n_knots, n_gen))
        first_schedules(
            (problems.load, problems.cost, problems.p_initial),
            fixed,
            (response.compliance, response.stiffness),
            (self.case.p_min, self.case.p_max, self.ramp),
            START_RATE * self.bound * self.spacing,
            mean_cost,
            start,
        )
        scale = np.maximum(mean_cost, SMALLEST_COST * max(1.0, n_gen / 2))
        return Outset(problems, served, theta, state, fixed, scale, start)

    def start_path(self, outset: Outset) -> Array:
        """Steady x under the first schedules at the stations, (batch, n_stations, n_gen), rad."""
        every = self.response.every
        p_load = outset.fixed[:, :: every * FINE]
        powers = outset.start[:, ::every] - outset.problems.p_initial[:, None]
        return np.asarray((powers - p_load) @ self.response.compliance)

    def along(self, outset: Outset, path: Array) -> Linear:
        """The grid linearised along paths of x at the fine points, (batch, n_fine, n_gen), rad.

        What swings faster than the time from one station to the next is averaged out.
        """
        return self.linearise(outset, averaged(path, self.response.every * FINE))

    def linearise(self, outset: Outset, slow: Array) -> Linear:
        """The grid linearised along slow paths of x.

        The power flow is solved at the stations. What it says that neither S nor ΔS do is taken as linear
        between them.

        Args:
            outset: of the problems.
            slow: x at the stations, (batch, n_stations, n_gen), rad.
        """
        response, problems = self.response, outset.problems
        points = response.every * FINE
        batch, n_stations, n_gen = slow.shape
        f = np.empty((batch, n_stations, n_gen))
        stiffness = np.empty((batch, len(response.instants), n_gen, n_gen))
        loads = np.ascontiguousarray(problems.load[:, ::points])
        generators, instants = self.network.generators, response.instants // response.every
        for b in range(batch):
            if outset.served[b]:
                angles = outset.theta[b, generators] + slow[b]
                network = self.lines, self.to_machines
                place = outset.theta[b], instants
                outset.served[b] = follow_path(*network, angles, loads[b], *place, f[b], stiffness[b])
        if not outset.served.all():
            bad = np.logical_not(outset.served)
            f[bad], stiffness[bad] = problems.p_initial[bad][:, None], response.stiffness
            slow = np.where(bad[:, None, None], 0.0, slow)
        change = stiffness - response.stiffness
        offset, modal = np.empty((batch, len(response.fine), n_gen)), np.empty_like(change)
        slack = np.empty(offset.shape[:2])
        constants = response.stiffness, self.between, response.gain, response.shape
        path_inputs(slow, f, change, outset.fixed, problems.load, constants, offset, modal, slack)
        return Linear(offset, modal, slack, change)

    def respond(self, powers: Array, outset: Outset, linear: Linear) -> tuple[Array, Array, Array]:
        """What the linearised grid does under powers at the knots, (batch, n_knots, n_gen), pu.

        Returns:
            At the fine points: x (batch, n_fine, n_gen), rad, ω likewise, rad/s, P_s (batch, n_fine), pu.
        """
        v = linear_between(powers @ self.response.gain, FINE) + linear.offset
        q, speed = np.empty_like(v), np.empty_like(v)
        q[:, 0], speed[:, 0] = outset.state[:, 0], outset.state[:, 1]
        swing(self.modes, linear.change, v, q, speed)
        x, omega = q @ self.response.shape, speed @ self.response.shape
        p_slack = linear.slack - (self.slack_stiffness(linear) * x).sum(axis=2)
        return x, omega, p_slack

    def slack_stiffness(self, linear: Linear) -> Array:
        """Σ_g of S + ΔS at the fine points, (batch, n_fine, n_gen), pu/rad."""
        return np.asarray(self.response.stiffness.sum(axis=0) + self.between @ linear.stiffness.sum(axis=2))


def linear_between(values: Array, points: int) -> Array:
    """Linear between rows, (batch, n, n_columns) to (batch, points (n - 1) + 1, n_columns)."""
    batch, n, n_columns = values.shape
    found = np.empty((batch, points * (n - 1) + 1, n_columns))
    for i in range(points):
        found[:, i:-1:points] = values[:, :-1] * (1 - i / points) + values[:, 1:] * (i / points)
    found[:, -1] = values[:, -1]
    return found
