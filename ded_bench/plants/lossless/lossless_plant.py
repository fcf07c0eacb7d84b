"""The plant `lossless`: the paper's structure-preserving network behind an infinite bus.

Classical machines on a lossless network; the delivered power is the set-point, and the slack bus takes what
is missing. See `network` for the equations.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.hold import Hold, across_intervals, doubled, series_step
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import NominalPoint, Piece, SimulationError, copied
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, State
from ded_bench.problem.lossless_case import lossless
from ded_bench.problem.schedule import Trajectory

if TYPE_CHECKING:
    from ded_bench.plants.lossless.stepper import Carried

#: Longest step times the fastest mode: far inside the region of stability; on the shipped grids ω is within
#: 4e-10 Hz of that of steps a tenth as long.
STEP_BY_MODE = 0.1
#: Where a linearisation follows, mismatch of the algebraic equations, pu, and how much longer steps may be: ω
#: is then within 1e-6 Hz (140bus).
PLANNING_MISMATCH, PLANNING_STEP = 1e-7, 2.0


class LosslessState(NamedTuple):
    """Where the grid is: angles and frequency deviations, the powers, and how finely steps are divided."""

    theta: Array  # of all buses, (n_bus,), rad, relative to the slack
    omega: Array  # (n_gen,), rad/s
    p_gen: Array  # (n_gen,), pu
    divisions: float  # steps per second of the integrator
    carried: Carried | None = None  # by the integrator; None: nothing happened before


@dataclass(frozen=True)
class LosslessPlant:
    """The lossless network of one case."""

    case: Case
    name: str = "lossless"

    def __post_init__(self) -> None:
        """Raise InputError unless the case's network is lossless."""
        lossless(self.case)

    @functools.cached_property
    def network(self) -> Network:
        """Its equations."""
        return Network(self.case)

    @property
    def fingerprint(self) -> str:
        """That of the case, which holds all of its data."""
        return self.case.fingerprint

    def initial(self, instance: Instance, estimate: LosslessState | None = None) -> LosslessState:
        """See `Plant.initial`; angles are those of `Network.initial_angles`."""
        theta = self.network.initial_angles(instance)
        fastest = float(np.abs(self.network.linearise(theta).modes()).max())
        omega, p_gen = instance.omega_initial(self.case), instance.p_initial(self.case)
        return LosslessState(theta, omega, p_gen, fastest / STEP_BY_MODE)

    def advance(
        self, state: LosslessState, p_set: Array, p_load: Array, dt_s: float, exact: bool = True
    ) -> Piece:
        """See `Plant.advance`; steps of fixed length lead from point to point, so that none spans a kink."""
        from ded_bench.plants.lossless import stepper  # and with it Numba: help does without

        network, n = self.network, len(p_set)
        found = stepper.GridStates(np.empty((n, network.n_bus)), np.empty(p_set.shape), np.empty(n))
        found.theta[0], found.omega[0] = state.theta, state.omega
        steps = max(int(np.ceil(state.divisions * dt_s / (1.0 if exact else PLANNING_STEP))), 1)
        powers = np.ascontiguousarray(p_set), network.load_injections(p_load)
        grid = network.grid if exact else network.grid._replace(mismatch=PLANNING_MISMATCH)
        carried = copied(state.carried) or stepper.carried_from(grid, state.theta)
        work = stepper.work_of(grid, state.theta, carried)
        if stepper.integrate(grid, stepper.GridInputs(*powers, dt_s, steps), carried, work, found) < n:
            raise SimulationError("the system cannot follow this schedule: the power flow has no solution")
        end = LosslessState(found.theta[-1], found.omega[-1], p_set[-1], state.divisions, carried)
        return Piece(found.omega, p_set, found.p_slack, found.theta, end)

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TimeVarying:
        """See `Plant.linearise_along`.

        Between two knots the reduced stiffness S is that of the middle of the interval: generator angles and
        loads determine the angles of all other buses (see `Network.linearise`). Deviations obey

            dδθ/dt = δω,    M dδω/dt = -D δω - S δθ + δP,    δP_s = -1ᵀ S δθ,

        advanced from grid point to grid point by the exact map of that equation (first-order hold).
        """
        network, n_gen = self.network, len(self.case.generators)
        stiffness = network.linearise(trajectory.states[(points[:-1] + points[1:]) // 2]).stiffness
        dt_s = float(trajectory.t[1] - trajectory.t[0])
        step = _one_step(stiffness / network.m[:, None], network.d / network.m, 1.0 / network.m, dt_s)
        slack, powers = -stiffness.sum(axis=1), doubled(step, np.diff(points))
        return TimeVarying(
            points=points,
            step=step,
            across=across_intervals(powers, np.diff(points)),
            speed=slice(n_gen, 2 * n_gen),
            slack=np.concatenate([slack, np.zeros_like(slack)], axis=1),
            omega=trajectory.omega,
            p_slack=trajectory.p_slack,
            p_gen=trajectory.p_set[points],
            powers=powers,
        )

    def observed(self, state: LosslessState) -> State:
        """Angles, frequency deviations and powers of the generators."""
        return State(state.theta[self.network.generators], state.omega, state.p_gen)

    def columns(self, states: Array) -> Mapping[str, Array]:
        """Angles of all buses, `theta_<bus>`, rad, relative to the slack."""
        columns = zip(lossless(self.case).buses, states.T, strict=True)
        return {f"theta_{bus.id}": column for bus, column in columns}

    def nominal(self) -> NominalPoint:
        """See `Plant.nominal`."""
        case, network = self.case, self.network
        try:
            theta = network.power_flow(case.p_nominal, case.load_nominal)
        except SimulationError as error:
            raise SimulationError(f"nominal powers: {error}") from None
        across = np.abs(theta @ network.incidence.T).max()
        p_slack = float(-case.p_nominal.sum() - case.load_nominal.sum())
        return NominalPoint(p_slack, float(np.degrees(across)), network.linearise(theta).modes())

    def static_dispatch(self, instance: Instance, times: Array) -> Array:
        """See `Plant.static_dispatch`: the merit order; the slack takes what is missing."""
        prices = instance.cost_gen(self.case), instance.cost_slack(self.case)
        return merit_order(self.case, *prices, instance.p_load(self.case, times))

    def set_points_delivering(self, p_gen: Array, dt_s: float) -> Array:
        """See `Plant.set_points_delivering`: set-points are delivered."""
        return p_gen

    def check_followed(self, instance: Instance) -> None:
        """See `Plant.check_followed`: its slack follows."""

    def balanced(self, instance: Instance) -> Instance:
        """The instance: its slack balances it."""
        return instance

    def check_servable(self, instance: Instance, source: str) -> None:
        """See `Plant.check_servable`.

        The power flow must serve the initial loads from P_0, and the loads at 0, at each kink and at the
        horizon from the static dispatch.
        """
        case, times = self.case, instance.kinks
        p_load, p_gen = instance.p_load(case, times), self.static_dispatch(instance, times)
        given = "power" if instance.initial.theta is None else "theta"
        try:
            self.network.initial_angles(instance)
        except SimulationError as error:
            problem = f"initial loads and {given} cannot be served: {error}"
            raise InputError(source, f"load, initial.{given}", problem) from None
        for t, gen, load in zip(times, p_gen, p_load, strict=True):
            try:
                self.network.power_flow(gen, load)
            except SimulationError as error:
                raise InputError(source, "load", f"loads at t = {t:g} s cannot be served: {error}") from None


def _one_step(stiffness: Array, damping: Array, gain: Array, dt_s: float) -> Hold:
    """The exact map over one grid step of (δθ, δω).

    Args:
        stiffness: M⁻¹ S, shape (n_maps, n_gen, n_gen), 1/s².
        damping: M⁻¹ D, shape (n_gen,), 1/s.
        gain: M⁻¹, shape (n_gen,).
        dt_s: grid step, s.
    """
    n_maps, n, _ = stiffness.shape

    def derivative(value: Array) -> Array:
        angle, speed = value[:, :n], value[:, n:]
        return np.concatenate([speed, -(stiffness @ angle) - damping[:, None] * speed], axis=1) * dt_s

    # |A dt| of (θ, ω / ω_fastest), in which the matrix is balanced.
    size = dt_s * (np.sqrt(np.abs(stiffness).sum(axis=2).max()) + damping.max())
    one, phi_1, phi_2 = series_step(derivative, n_maps, 2 * n, size)
    return Hold(one, dt_s * phi_1[:, :, n:] * gain, dt_s * phi_2[:, :, n:] * gain)
