"""The grid in modal coordinates: linearised along a trajectory, and what it answers to generator power.

With x the generators' angles relative to those at t = 0 and the same damping rate γ for all of them,

    M ẍ + γ M ẋ + (S + ΔS(t)) x = P - P_0 - T (L - L_0) - r(t)

where S and T are the reduced stiffness and load share of the nominal point, ΔS is what stiffness changes
along a trajectory, and r is all that is not in them. In modal coordinates x = q shape each mode is an
oscillator of its own, which is advanced exactly from one point of the time grid to the next under an input
that is linear between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.admm.coarse_dispatch import coarse_grid, dispatch_angles
from ded_bench.methods.admm.modal_kernels import Modes, oscillators, swing
from ded_bench.methods.admm.problems import POINTS
from ded_bench.methods.knots import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.plants.lossless import algebraic
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row
from ded_bench.problem.quantities import Indices, largest_divisor
from ded_bench.surrogates.koopman import hat_functions

#: Mismatch of a power flow that is good enough here, pu.
MISMATCH = 1e-5
#: What a step has to leave of it: more than elsewhere, since angles need not be as exact.
CONTRACTION = 0.3
#: Damping rates that differ by less than this part are the same in all but the digits of the data.
ROUND_OFF = 1e-6
#: Knots at which the stiffness along a trajectory is taken; linear between them.
STIFFNESS_KNOTS = 5
#: Longest time from one power flow along a trajectory to the next, s, but where half of the time between
#: coarse knots is longer.
FLOWS_S = 0.8
#: Costs are relative to the merit order, but an instance is not worth more than this mean cost per
#: pair of generators.
SMALLEST_COST = 0.05


@dataclass(frozen=True, eq=False)
class Start:
    """What is known of problems before any decision."""

    problems: StackedInstances
    served: NDArray[np.bool_]  # whether there is a power flow, (batch,)
    theta: Array  # equilibrium angles at t = 0, (batch, n_bus), rad
    state: Array  # modes at t = 0: q, q̇, (batch, 2, n_modes)
    demand: Array  # -L of all loads on the time grid, (batch, n_points), pu
    taken: Array  # T (L - L_0) there, (batch, n_points, n_gen), pu
    scale: Array  # what costs are relative to: mean cost of the merit order, (batch,)
    schedule: Array  # first schedule, (batch, n_knots, n_gen), pu


@dataclass(frozen=True, eq=False)
class ModalLinearisation:
    """The grid linearised along a trajectory: what is not P in the modes' inputs, changes of stiffness."""

    offset: Array  # -T (L - L_0) - r + ΔS x of the trajectory, less P_0, (batch, n_points, n_modes)
    change: Array  # ΔS of the modes, (batch, n_stiffness, n_modes, n_modes), 1/s²
    slack: Array  # P_s at x = 0, (batch, n_points), pu
    stiffness: Array  # ΔS, (batch, n_stiffness, n_gen, n_gen), pu/rad


class ModalGrid:
    """The grid of one case, for one bound on |ω| (rad/s) and one horizon."""

    def __init__(self, case: Case, bound: float, horizon_s: float) -> None:
        self.case, self.bound, self.network = case, bound, Network(case)
        self.knots = knots = case.knot_times(horizon_s)
        #: The time grid: knots and points between them, (n_points,), s.
        self.points = np.linspace(knots[0], knots[-1], POINTS * (len(knots) - 1) + 1)
        self.spacing = float(knots[1] - knots[0])
        self.ramp = case.ramp * self.spacing
        self._linearise_nominal()
        self.coarse = coarse_grid(case, knots, bound, self.stiffness, self.compliance)
        #: Knots from one power flow along a trajectory to the next; those where stiffness is taken.
        flows = max(FLOWS_S / self.spacing, 0.5 * self.coarse.every)
        self.every = largest_divisor(len(knots) - 1, flows)
        n_flows = (len(knots) - 1) // self.every + 1
        taken = np.linspace(0, n_flows - 1, min(STIFFNESS_KNOTS, n_flows)).round().astype(np.int64)
        self.stiffness_knots = self.every * taken
        #: Linear interpolation from there to the time grid, and shares of a mean over time.
        self.between = hat_functions(self.points, knots[self.stiffness_knots])
        self.shares = np.trapezoid(self.between, self.points, axis=0) / self.points[-1]
        #: Means around power flows, weighted by hat functions; both ends are kept as they are.
        self._means = hat_functions(self.points, knots[:: self.every]).T / (self.every * POINTS)
        self._means[[0, -1]] = np.eye(len(self.points))[[0, -1]]
        half = 0.5 * float(self.points[1])
        self.modes = Modes(self._step, half * self._damping, half, self.stiffness_knots * POINTS)
        #: Solved for generators and buses without machines, and for these, which the last one eliminates.
        network, n_gen = self.network, len(self.mass)
        buses = np.concatenate([network.generators, network.algebraic])
        self._whole, grid = (
            g._replace(mismatch=MISMATCH, contraction=CONTRACTION)
            for g in (network.grid_of(buses), network.grid)
        )
        self._grids = grid, network.grid_of(buses, kept=n_gen)
        self._factors = [np.empty(len(g.algebraic) + len(g.elimination.met)) for g in (self._whole, grid)]
        for g, factor in zip((self._whole, grid), self._factors, strict=True):
            algebraic.factorise(g, self.theta, factor)

    def _linearise_nominal(self) -> None:
        self.theta = self.network.power_flow(self.case.p_nominal, self.case.load_nominal)
        linear = self.network.linearise(self.theta)
        root = np.sqrt(linear.m)
        squares, u = np.linalg.eigh(linear.stiffness / np.outer(root, root))
        self.rate = float(linear.d.sum() / linear.m.sum())  # γ, 1/s
        other = linear.d / linear.m - self.rate
        other[np.abs(other) < ROUND_OFF * self.rate] = 0.0
        self.stiffness = linear.stiffness  # S, (n_gen, n_gen), pu/rad
        self.compliance = np.asarray(np.linalg.inv(linear.stiffness))
        self.share = linear.share  # T, (n_gen, n_load)
        self.mass = linear.m / linear.m.mean()
        self.gain = u / root[:, None]  # powers into modes, (n_gen, n_modes): v = p @ gain
        self.shape = (u / root[:, None]).T.copy()  # modes into angles, (n_modes, n_gen): x = q @ shape
        self._inverse = np.linalg.inv(self.shape)
        maps = oscillators(squares, self.rate, float(self.points[1]))
        self._step = np.ascontiguousarray(np.moveaxis(maps, 0, 2))
        self._damping = u.T @ np.diag(other) @ u  # of the modes, less γ, (n_modes, n_modes), 1/s

    def start(self, problems: StackedInstances) -> Start:
        """Angles at t = 0 and the first schedule."""
        network, batch = self.network, len(problems)
        theta, served = np.tile(self.theta, (batch, 1)), np.empty(batch, bool)
        wanted = np.hstack([problems.p_initial, network.load_injections(problems.load[:, 0])])
        solve_power_flows(self._whole, wanted, self._factors[0], theta, served)
        demand = -problems.load.sum(axis=2)
        taken = (problems.load - problems.load[:, :1]) @ self.share.T
        state = np.stack([problems.delta @ self._inverse, problems.omega @ self._inverse], axis=1)
        scale, schedule = self._first(problems, demand, taken)
        return Start(problems, served, theta, state, demand, taken, scale, schedule)

    def _first(self, problems: StackedInstances, demand: Array, taken: Array) -> tuple[Array, Array]:
        """Mean cost of the merit order, (batch,), and first schedules, (batch, n_knots, n_gen), pu."""
        case, every, p_initial = self.case, self.coarse.every, problems.p_initial[:, None]
        order = np.argsort(problems.cost[:, 1:], kind="stable")
        scale = np.full(len(problems), SMALLEST_COST * max(1.0, len(self.gain) / 2))
        base, coarse_demand = p_initial + taken[:, :: every * POINTS], demand[:, :: every * POINTS]
        x = dispatch_angles(self.coarse, base, coarse_demand, problems.cost, order, scale)
        schedule = p_initial + taken[:, ::POINTS] + linear_between(x @ self.stiffness, every)
        track(schedule, case.p_min, case.p_max, self.ramp)
        return scale, schedule

    def along_first(self, start: Start) -> ModalLinearisation:
        """The grid linearised along the steady angles of the first schedules."""
        powers = start.schedule[:, :: self.every] - start.problems.p_initial[:, None]
        return self.linearise(start, (powers - start.taken[:, :: self.every * POINTS]) @ self.compliance)

    def along(self, start: Start, x: Array) -> ModalLinearisation:
        """The grid linearised along trajectories of x on the time grid, (batch, n_points, n_gen), rad.

        What swings faster than the time from one power flow to the next is averaged out.
        """
        return self.linearise(start, self._means @ x)

    def linearise(self, start: Start, slow: Array) -> ModalLinearisation:
        """The grid linearised along slow trajectories of x.

        What the power flow says that neither S nor ΔS do is taken as linear between two power flows.

        Args:
            start: of the problems; those without a power flow all along are `served` no more.
            slow: x at every `every`-th knot, (batch, n_flows, n_gen), rad.
        """
        problems, points = start.problems, self.every * POINTS
        batch, n_flows, n_gen = slow.shape
        f = np.empty((batch, n_flows, n_gen))
        stiffness = np.empty((batch, len(self.stiffness_knots), n_gen, n_gen))
        wanted = self.network.load_injections(problems.load[:, ::points])
        generators, at = self.network.generators, self.stiffness_knots // self.every
        for b in range(batch):
            if start.served[b]:
                angles, factor = start.theta[b, generators] + slow[b], self._factors[1].copy()
                start.served[b] = follow_trajectory(
                    self._grids, angles, wanted[b], factor, start.theta[b], at, f[b], stiffness[b]
                )
        if not start.served.all():
            bad = np.logical_not(start.served)
            f[bad], stiffness[bad] = problems.p_initial[bad][:, None], self.stiffness
            slow = np.where(bad[:, None, None], 0.0, slow)
        change = stiffness - self.stiffness
        rest = f - slow @ self.stiffness
        rest -= np.einsum("ks,bskg->bkg", self.between[::points], slow[:, None] @ change)
        whole = start.taken + linear_between(rest - start.taken[:, ::points], points)
        slack = start.demand - whole.sum(axis=2)
        return ModalLinearisation(-(whole @ self.gain), self.gain.T @ change @ self.shape.T, slack, change)

    def respond(self, powers: Array, start: Start, linear: ModalLinearisation) -> tuple[Array, Array, Array]:
        """What the linearised grid does under powers at the knots, (batch, n_knots, n_gen), pu.

        Returns:
            On the time grid: x (batch, n_points, n_gen), rad, ω likewise, rad/s, P_s (batch, n_points), pu.
        """
        v = linear_between(powers @ self.gain, POINTS) + linear.offset
        q, speed = np.empty_like(v), np.empty_like(v)
        q[:, 0], speed[:, 0] = start.state[:, 0], start.state[:, 1]
        for b in range(len(v)):
            swing(self.modes, linear.change[b], v[b], q[b], speed[b])
        x, omega = q @ self.shape, speed @ self.shape
        return x, omega, linear.slack - (self.slack_stiffness(linear) * x).sum(axis=2)

    def slack_stiffness(self, linear: ModalLinearisation) -> Array:
        """Σ_g of S + ΔS on the time grid, (batch, n_points, n_gen), pu/rad."""
        return np.asarray(self.stiffness.sum(axis=0) + self.between @ linear.stiffness.sum(axis=2))


@compiled
def linear_between(values: Array, points: int) -> Array:
    """Linear between rows, (batch, n, n_columns) to (batch, points (n - 1) + 1, n_columns)."""
    batch, n, n_columns = values.shape
    found = np.empty((batch, points * (n - 1) + 1, n_columns))
    for b in range(batch):
        for k in range(n - 1):
            for i in range(points):
                for c in range(n_columns):
                    change = values[b, k + 1, c] - values[b, k, c]
                    found[b, points * k + i, c] = values[b, k, c] + i / points * change
        copy_row(values[b, n - 1], found[b, points * (n - 1)])
    return found


@compiled
def solve_power_flows(
    grid: algebraic.CompiledGrid, wanted: Array, factor: Array, theta: Array, served: NDArray[np.bool_]
) -> None:
    """Power flows of a batch, each from the same angles.

    Args:
        grid: solves for all buses but the slack.
        wanted: injections there, (batch, n_algebraic), pu.
        factor: of the Jacobian at the first angles, (n_factor,).
        theta: angles of all buses to start from; receives the answers, (batch, n_bus), rad.
        served: receives whether there is one with less than 90° across each line, (batch,).
    """
    f, work = np.empty(theta.shape[1]), (np.empty(wanted.shape[1]), np.empty(len(grid.coupling)))
    for b in range(len(theta)):
        served[b] = algebraic.solve_algebraic(grid, wanted[b], factor.copy(), theta[b], f, work)
        for i in range(len(grid.lines)):
            across = theta[b, grid.lines[i, 0]] - theta[b, grid.lines[i, 1]]
            served[b] = served[b] and abs(across) < 0.5 * np.pi


@compiled
def follow_trajectory(
    grids: tuple[algebraic.CompiledGrid, algebraic.CompiledGrid],
    angles: Array,
    wanted: Array,
    factor: Array,
    theta: Array,
    taken: Indices,
    f: Array,
    stiffness: Array,
) -> bool:
    """Electrical power of the generators along a trajectory of their angles, and its derivative.

    Args:
        grids: the network; the first solves for buses without machines, which the second eliminates.
        angles: of the generators at the power flows, (n_flows, n_gen), rad.
        wanted: injections at the other buses there, (n_flows, n_algebraic), pu.
        factor: of the Jacobian of these buses somewhere near; is renewed, (n_factor,).
        theta: angles of all buses near the first ones, (n_bus,), rad.
        taken: at which power flows the derivative is taken; the first is one, (n_stiffness,).
        f: receives electrical powers of the generators, (n_flows, n_gen), pu.
        stiffness: receives ∂f/∂θ of the generators, (n_stiffness, n_gen, n_gen), pu/rad.

    Returns:
        Whether there is a solution all along.
    """
    grid, reduced = grids
    work = np.empty(len(grid.algebraic)), np.empty(len(grid.coupling))
    n, n_gen, at = len(grid.algebraic), angles.shape[1], 0
    angle, injection, before, change = theta.copy(), np.empty_like(theta), theta.copy(), np.zeros(len(theta))
    full, eliminated = np.empty((n_gen + n, n_gen + n)), np.empty(n + len(reduced.elimination.met))
    for k in range(len(angles)):
        for i in range(n):
            bus = grid.algebraic[i]
            angle[bus] = before[bus] + change[bus]
        for g in range(n_gen):
            angle[grid.generators[g]] = angles[k, g]
        if not algebraic.solve_algebraic(grid, wanted[k], factor, angle, injection, work):
            return False
        for i in range(len(angle)):
            change[i] = angle[i] - before[i] if k > 0 else 0.0
            before[i] = angle[i]
        for g in range(n_gen):
            f[k, g] = injection[grid.generators[g]]
        if at < len(taken) and taken[at] == k:
            algebraic.factorise(grid, angle, factor)
            algebraic.set_jacobian(reduced, angle, full)
            algebraic.eliminate(reduced.elimination, full, eliminated)
            for g in range(n_gen):
                copy_row(full[g], stiffness[at, g])
            at += 1
    return True
