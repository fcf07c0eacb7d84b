"""Full DED as a short sequence of linear programs: the problem of `ded`, solved faster.

Given the generators' angles, the loads fix all others, so that the paper's eq. (DED_OG) under backward
Euler has one nonlinear part: f at the generators and the slack bus. It is linearised along the last
trajectory, exactly in the loads, and a linear program without the other angles is solved; where
f is met to `TOLERANCE` the trajectory meets the optimality conditions of the nonlinear program, since then
both programs have the same derivatives there. Newton's convergence makes that two to four programs.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ded_bench.methods.slp import Attempt, Parts, sequence
from ded_bench.methods.solution import Solution
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.linear_program import FreeForm
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status

#: Mismatch of the nonlinear equations that ends the sequence, pu: IPOPT's tolerance for the same ones.
TOLERANCE = 1e-8
#: A sequence that is longer does not converge.
MAX_PROGRAMS = 10


@dataclass(frozen=True, eq=False)
class Injections:
    """f at generators and slack along a trajectory, with derivatives for the generators' angles."""

    at: Array  # the generators' angles, (n, n_gen), rad
    f: Array  # (n, n_gen + 1), pu; the slack last
    slope: Array  # (n, n_gen + 1, n_gen), pu/rad

    def predicted(self, theta: Array) -> Array:
        """f at other angles, linearly."""
        return np.asarray(self.f + np.einsum("nij,nj->ni", self.slope, theta - self.at))


def injections_along(network: Network, theta_gen: Array, p_load: Array) -> Injections:
    """f and its total derivative, angles of the other buses eliminated by the loads (index 1).

    Args:
        network: the network.
        theta_gen: angles of the generators, shape (n, n_gen), rad.
        p_load: load injections, shape (n, n_load), pu.

    Raises:
        SimulationError: the loads cannot be served at these angles.
    """
    gen, alg = network.generators, network.algebraic
    theta = np.zeros((len(theta_gen), network.n_bus))
    theta[:, gen] = theta_gen
    theta, _ = network.solve_loads(theta, network.load_injections(p_load))
    weights = network.coupling * np.cos(theta @ network.incidence.T)
    full = np.einsum("li,nl,lj->nij", network.incidence, weights, network.incidence, optimize=True)
    rows = np.append(gen, network.slack)
    moved = np.linalg.solve(full[:, alg[:, None], alg], full[:, alg[:, None], gen])
    slope = full[:, rows[:, None], gen] - full[:, rows[:, None], alg] @ moved
    return Injections(theta_gen, network.injections(theta)[:, rows], slope)


class EulerPrograms:
    """The linear programs of one case, regime and grid: a fixed pattern of rows and columns.

    Columns at every t_k, k > 0: θ, ω and power of the generators, P_s up and down. Equations at every t_k:

        (θ_k - θ_{k-1}) / dt - ω_k = 0
        M (ω_k - ω_{k-1}) / dt + D ω_k - P_k + f(θ_k) = 0
        P_s,up - P_s,down - f_s(θ_k) = 0
    """

    def __init__(self, case: Case, regime: str, steps: int, dt: float) -> None:
        self._case, self._network, self._steps, self._dt = case, Network(case), steps, dt
        n_gen, m_dt = len(case.generators), self._network.m / dt
        now = np.zeros((2 * n_gen + 1, 3 * n_gen + 2))  # of one step
        before = np.zeros_like(now)
        theta, omega, power = (np.arange(i * n_gen, (i + 1) * n_gen) for i in range(3))
        now[theta, theta], now[theta, omega], before[theta, theta] = 1 / dt, -1.0, -1 / dt
        now[omega, omega], now[omega, power], before[omega, omega] = m_dt + self._network.d, -1.0, -m_dt
        now[-1, -2:] = 1.0, -1.0
        step, shift = sp.eye(steps, format="csr"), sp.eye(steps, k=-1, format="csr")
        self._constant = sp.csr_matrix(sp.kron(step, now) + sp.kron(shift, before))
        self._ramps = sp.csc_matrix(sp.kron((step - shift) / dt, sp.eye(n_gen, now.shape[1], k=2 * n_gen)))
        endless, limit = np.full(n_gen, np.inf), np.full(n_gen, case.omega_bound(regime))
        self._lower = np.tile(np.concatenate([-endless, -limit, case.p_min, np.zeros(2)]), steps)
        self._upper = np.tile(np.concatenate([endless, limit, case.p_max, np.full(2, np.inf)]), steps)

    def solve(self, instance: Instance, time_limit_s: float | None = None) -> Solution:
        """Solve one instance; the first trajectory stays in the state at t = 0.

        Returns:
            `Optimal` with a schedule, `TimeLimit`, or `Failed` if a program has no solution or the sequence
            does not converge, which says nothing about the instance.
        """
        started = time.perf_counter()
        network, load = self._network, instance.p_load(self._case)
        initial = network.initial_angles(instance)[network.generators]

        def follow(theta: Array) -> Injections:
            return injections_along(network, theta, load)

        def solve(along: Injections, _: int) -> Attempt[tuple[Injections, Array]]:
            found = solve_form(self._program(instance, along))
            theta = np.vstack([initial, found.x.reshape(self._steps, -1)[:, : len(initial)]])
            said = found.iterations, found.version, found.message
            return Attempt(found.status, theta, (along, found.x), *said)

        def is_met(now: Injections, solution: tuple[Injections, Array]) -> bool:
            return bool(np.abs(now.f - solution[0].predicted(now.at)).max() < TOLERANCE)

        deadline = started + (np.inf if time_limit_s is None else time_limit_s)
        still = np.tile(initial, (len(load), 1))
        end = sequence(Parts(follow, solve, is_met, MAX_PROGRAMS, tries=1), [still], deadline)
        schedule, objective = None, None
        if end.status == Status.OPTIMAL and end.answer and end.answer.solution and end.followed:
            columns = end.answer.solution[1].reshape(self._steps, -1)
            power = np.vstack([instance.p_initial(self._case), columns[:, 2 * len(initial) : -2]])
            schedule = Schedule(t=instance.grid, p=power)
            p_slack = np.abs(end.followed.f[:, -1])
            cost = power @ instance.cost_gen(self._case) + instance.cost_slack(self._case) * p_slack
            objective = float(cost.sum())
        return Solution(
            status=end.status,
            schedule=schedule,
            iterations=end.iterations,
            setup_s=0.0,
            solve_s=time.perf_counter() - started,
            solver_objective=objective,
            solver_version=end.answer.version if end.answer else "",
            error=end.message if schedule is None else "",
        )

    def _program(self, instance: Instance, along: Injections) -> FreeForm:
        """The linear program around a trajectory of angles."""
        case, dt, n_gen, theta = self._case, self._dt, len(self._case.generators), along.at
        sign = np.append(np.ones(n_gen), -1.0)  # of f in the equations
        slopes = np.zeros((self._steps, 2 * n_gen + 1, 3 * n_gen + 2))
        slopes[:, n_gen:, :n_gen] = along.slope[1:] * sign[:, None]
        block = np.arange(self._steps + 1)
        equal = sp.csc_matrix(self._constant + sp.bsr_matrix((slopes, block[:-1], block)).tocsr())
        offset = np.einsum("nij,nj->ni", along.slope[1:], theta[1:]) - along.f[1:]
        right = np.zeros(slopes.shape[:2])
        right[:, n_gen:] = offset * sign
        right[0, :n_gen] += theta[0] / dt
        right[0, n_gen:-1] += self._network.m / dt * instance.omega_initial(case)
        limit = np.tile(case.ramp, (self._steps, 1))
        start = np.zeros_like(limit)
        start[0] = instance.p_initial(case) / dt
        prices = [np.zeros(2 * n_gen), instance.cost_gen(case), np.full(2, instance.cost_slack(case))]
        return FreeForm(
            cost=np.tile(np.concatenate(prices), self._steps),
            equal=equal,
            right=right.ravel(),
            between=self._ramps,
            low=(start - limit).ravel(),
            high=(start + limit).ravel(),
            lower=self._lower,
            upper=self._upper,
        )
