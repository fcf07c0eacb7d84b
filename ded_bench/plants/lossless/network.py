"""Structure-preserving swing equations of one case: power flow, index-1 DAE, linearisation.

Angles are relative to the slack bus, which is held at θ_s = 0, ω_s = 0. Differential states are
(θ, ω) of the generators; the angles of all other buses follow from the algebraic equations
L_i = f_i(θ). Everything is batched over leading dimensions.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.lossless_case import lossless

if TYPE_CHECKING:
    from ded_bench.plants.lossless.algebraic import CompiledGrid

#: Newton stops at this mismatch, pu, or where lines of great coupling let doubles resolve no less.
MISMATCH, RESOLUTION = 1e-12, 4 * np.finfo(float).eps


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The swing DAE linearised at equilibria (leading dimensions), with load angles eliminated.

    M dω/dt = -D ω + δP_gen - δf, with δf = stiffness @ δθ + share @ δP_load; the slack delivers
    δP_s = -Σ δf - Σ δP_load.
    """

    stiffness: Array  # (n_gen, n_gen), pu/rad
    share: Array  # (n_gen, n_load): instantaneous change of f at the generators, pu/pu
    slack_share: Array  # (n_load,): instantaneous change of P_s, pu/pu
    m: Array
    d: Array

    @property
    def matrix(self) -> Array:
        """That of the linearised dynamics in (θ, ω), (2 n_gen, 2 n_gen)."""
        nothing, one = np.zeros_like(self.stiffness), np.eye(len(self.m))
        return np.block([[nothing, one], [-self.stiffness / self.m[:, None], -np.diag(self.d / self.m)]])

    def modes(self) -> NDArray[np.complex128]:
        """Eigenvalues in rad/s of the linearised dynamics, shape (2 n_gen,), complex."""
        return np.linalg.eigvals(self.matrix).astype(np.complex128)


class Network:
    """The lossless network of a case: injections f(θ) and the equations that fix load angles.

    Couplings are b_ij = |V_i||V_j| / |r_ij + j x_ij|, so that f_i = Σ_j b_ij sin(θ_i - θ_j)
    (paper, eq. for f_i). Angles are arrays over all buses in the case's order.
    """

    def __init__(self, given: Case) -> None:
        case = lossless(given)
        index = {bus.id: i for i, bus in enumerate(case.buses)}
        voltage = np.array([bus.v for bus in case.buses])
        self.ends = ends = np.array([[index[line.from_bus], index[line.to_bus]] for line in case.lines])
        impedance = np.array([abs(complex(line.r, line.x)) for line in case.lines])
        self.case = case
        self.n_bus = len(case.buses)
        self.slack = index[case.slack]
        self.generators = np.array([index[bus] for bus in case.generators])
        self.loads = np.array([index[bus] for bus in case.loads])
        fixed = {self.slack, *self.generators.tolist()}
        self.algebraic = np.array([i for i in range(self.n_bus) if i not in fixed])
        self.unknown = np.array([i for i in range(self.n_bus) if i != self.slack])
        self.coupling = voltage[ends].prod(axis=1) / impedance
        self.incidence = np.zeros((len(case.lines), self.n_bus))
        self.incidence[np.arange(len(ends)), ends[:, 0]] = 1.0
        self.incidence[np.arange(len(ends)), ends[:, 1]] = -1.0
        self.m = np.array([case.machines[g].m for g in case.generators])
        self.d = np.array([case.machines[g].d for g in case.generators])
        self.mismatch = max(MISMATCH, RESOLUTION * float(self.coupling.max()))
        self._flat = self.incidence.T @ (self.coupling[:, None] * self.incidence)

    @functools.cached_property
    def grid(self) -> CompiledGrid:
        """What compiled functions see of this network."""
        return self.grid_of(self.algebraic)

    @functools.cached_property
    def _whole_grid(self) -> CompiledGrid:
        return self.grid_of(self.unknown)

    def grid_of(self, algebraic: NDArray[np.int_], kept: int = 0) -> CompiledGrid:
        """With other buses whose angles follow from injections; the first `kept` are not eliminated."""
        from ded_bench.plants.lossless import algebraic as compiled  # with it Numba: help does without

        place = {bus: i for i, bus in enumerate(algebraic.tolist())}
        inner = [[place[bus] for bus in ends] for ends in self.ends.tolist() if place.keys() >= {*ends}]
        order = compiled.elimination_order(inner, len(algebraic), kept)
        buses = self.generators, algebraic, order, self.slack
        machines, accuracy = (self.m, self.d), (self.mismatch, compiled.CONTRACTION)
        return compiled.CompiledGrid(self.ends, self.coupling, *buses, *machines, *accuracy)

    def injections(self, theta: Array) -> Array:
        """f(θ) at every bus, shape (..., n_bus), pu; sums to zero since lines are lossless."""
        return np.asarray((np.sin(theta @ self.incidence.T) * self.coupling) @ self.incidence)

    def load_injections(self, p_load: Array) -> Array:
        """Injections at the algebraic buses, shape (..., n_algebraic): loads, and zero at junctions."""
        full = np.zeros((*p_load.shape[:-1], self.n_bus))
        full[..., self.loads] = p_load
        return np.take(full, self.algebraic, axis=-1)

    def solve_loads(self, theta: Array, injection: Array) -> tuple[Array, Array]:
        """Angles and injections of all buses, given angles of generators and slack: L_i = f_i(θ), index 1.

        Args:
            theta: angles, shape (..., n_bus); load entries are Newton's first guess.
            injection: wanted injections at the algebraic buses (see `load_injections`).

        Returns:
            θ, rad, and f(θ), pu; each of shape (..., n_bus).

        Raises:
            SimulationError: no solution from this guess.
        """
        return self._newton(theta, injection, self.grid)

    def power_flow(self, p_gen: Array, p_load: Array) -> Array:
        """Equilibrium angles for given generator and load injections, shape (..., n_bus), rad.

        Raises:
            SimulationError: there is no solution, or it is not a stable one (an angle across a line
                beyond 90 degrees).
        """
        shape = np.broadcast_shapes(p_gen.shape[:-1], p_load.shape[:-1])
        wanted = np.zeros((*shape, self.n_bus))
        wanted[..., self.generators] = p_gen
        wanted[..., self.loads] = p_load
        theta, _ = self._newton(np.zeros_like(wanted), wanted[..., self.unknown], self._whole_grid)
        if not (np.abs(theta @ self.incidence.T) < np.pi / 2).all():
            raise SimulationError("an angle across a line exceeds 90 degrees")
        return theta

    def initial_angles(self, instance: Instance) -> Array:
        """Angles at t = 0, shape (n_bus,), rad.

        The power flow of P_0 and the initial loads, unless the instance gives the generators' angles: then
        the loads fix the others.

        Raises:
            SimulationError: there are no such angles.
        """
        p_load = instance.p_load(self.case, np.zeros(1))[0]
        theta = instance.theta_initial(self.case)
        if theta is None:
            return self.power_flow(instance.p_initial(self.case), p_load)
        angles = np.zeros(self.n_bus)
        angles[self.generators] = theta
        # Newton's guess: angles that the lines, linearised at zero, would give the other buses.
        alg, gen, wanted = self.algebraic, self.generators, self.load_injections(p_load)
        drawn = wanted - self._flat[np.ix_(alg, gen)] @ theta
        angles[alg] = np.linalg.solve(self._flat[np.ix_(alg, alg)], drawn)
        return self.solve_loads(angles, wanted)[0]

    def linearise(self, theta: Array) -> Linearisation:
        """Linearise at the angles of equilibria, shape (..., n_bus)."""
        weights = self.coupling * np.cos(theta @ self.incidence.T)
        full = self.incidence.T @ (weights[..., None] * self.incidence)
        gen, alg = self.generators[:, None], self.algebraic
        to_load = np.zeros((len(alg), len(self.loads)))
        to_load[np.searchsorted(alg, self.loads), np.arange(len(self.loads))] = 1.0
        inverse = np.linalg.inv(full[..., alg[:, None], alg])
        share = full[..., gen, alg] @ inverse @ to_load
        stiffness = full[..., gen, gen.T] - full[..., gen, alg] @ inverse @ full[..., alg[:, None], gen.T]
        slack_share = (full[..., [[self.slack]], alg] @ inverse @ to_load)[..., 0, :]
        symmetric = 0.5 * (stiffness + stiffness.swapaxes(-1, -2))
        return Linearisation(symmetric, share, slack_share, self.m, self.d)

    def _newton(self, theta: Array, wanted: Array, grid: CompiledGrid) -> tuple[Array, Array]:
        from ded_bench.plants.lossless.algebraic import solve_angles  # here only, as in `grid`

        theta, f = np.array(theta), np.empty(theta.shape)
        rows = theta.reshape(-1, self.n_bus), f.reshape(-1, self.n_bus)
        n = len(grid.algebraic)
        wanted = np.array(np.broadcast_to(wanted, (*theta.shape[:-1], n)).reshape(-1, n), order="C")
        if not solve_angles(grid._replace(contraction=0.0), wanted, *rows):  # from far: Newton steps alone
            raise SimulationError("the power flow has no solution")
        return theta, f
