"""The ADMM of `ded-admm` without torch, whose overhead would dominate a single answer.

The linear program along a trajectory of a problem is

    min Σ c P + c_s |P_s|   with P, P⁺ - P and ω within limits, all affine in P.

Each iteration of the alternating direction method of multipliers (Boyd et al. 2011) projects copies of P, its
changes, ω and P_s on their limits (for P_s: the proximal map of its price), and then moves P to the least of
a quadratic model. Powers weigh by the inverse of inertia and frequencies alike; with each mode of the mean
stiffness taken to move alone, the model falls apart into one small recursion per mode. A few iterations are
far from convergence: how they weigh what they minimise is learned, and the only weights of the policy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.methods.admm.modal_grid import ModalGrid, ModalLinearisation, Start
from ded_bench.methods.admm.modal_kernels import (
    Floats,
    MeanModes,
    Modes,
    mean_modes,
    modal_change,
    swing,
    swing_adjoint,
)
from ded_bench.methods.admm.problems import POINTS
from ded_bench.methods.knots import track
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Array32
from ded_bench.surrogates.koopman import hat_functions

#: Where training starts: in the first iteration and the last, and between by equal factors. Penalties, of
#: bounds, ramps, ω and P_s, in the case's `price`; how often the quadratic model counts the last two;
#: relaxation; tightening of the bound on |ω|.
SETTINGS = {
    "bounds": (0.1, 400.0),
    "ramps": (40.0, 1500.0),
    "frequency": (60.0, 4000.0),
    "slack": (0.1, 15.0),
    "frequency_model": (1.2, 1.2),
    "slack_model": (2.5, 0.4),
    "relaxation": (1.4, 1.7),
    "tightening": (0.09, 0.03),
}
#: How many of them are penalties.
PENALTIES = 4
#: Largest relaxation and tightening.
MOST = {"relaxation": 2.0, "tightening": 0.1}
#: Iterations, equally far apart, whose weights are learned; those of others lie between.
NODES = 4
#: Price of one relative unit of excess of |ω| for one second, as a fraction of the instance's cost: an
#: exact penalty. studies/admm.md tells how it was chosen.
PRICE = 0.1
#: Relative excess at which the price has doubled: rare large excesses count for more than many small ones.
DOUBLING = 0.05
#: Relative excess beyond which the price stays as it is: at first a few schedules are far outside.
STRAIGHT = 0.2
#: Vectors of the processor take so many modes; what is left over, if more than so many, is filled up.
VECTOR, LEFT_OVER = 8, 4


class AdmmLimits(NamedTuple):
    """Limits of a case, and what makes them comparable."""

    low: Array  # (n_gen,), pu, as the next two
    high: Array
    step: Array  # largest change between knots by ramps
    bound: float  # of |ω|, rad/s
    is_tight: bool  # see `CoarseGrid`
    mass: Array  # M in means of all, (n_gen,)
    unit: float  # of powers: what ramps and the bound allow between knots, pu
    price: float  # one unit at one knot, as a part of what all generators can give at all of them
    gain: Array32  # see `ModalGrid`, as the next
    shape: Array32


class AdmmProblems(NamedTuple):
    """What is known of a batch before the first iteration."""

    cost: Array  # (slack, generators), as parts of `Start.scale`, (batch, 1 + n_gen), 1/pu
    offset: Array32  # see `ModalLinearisation`: (batch, n_points, n_modes)
    slack: Array32  # (batch, n_points), pu
    slack_of_mode: Array32  # what a mode takes from the slack, (batch, n_points, n_modes), pu/rad
    change: Array32  # (batch, n_stiffness, n_modes, n_modes), 1/s²
    state: Array32  # (batch, 2, n_modes)
    mean: MeanModes


def starting_settings(iterations: int) -> Array:
    """Settings where training starts, (iterations, 8)."""
    return np.stack([np.geomspace(*ends, iterations) for ends in SETTINGS.values()], axis=1)


def between_nodes(iterations: int) -> Array:
    """Linear interpolation from the nodes to all iterations, (iterations, NODES)."""
    return hat_functions(np.linspace(0.0, NODES - 1.0, iterations), np.arange(NODES, dtype=float))


def settings_of(weights: Array, iterations: int) -> Array:
    """Settings of each iteration, (iterations, 8), from weights, which are 0 where training starts.

    Penalties are multiplied by e^w; what has a largest value moves to it along a logistic curve.
    """
    start = starting_settings(iterations)
    found = start * np.exp(between_nodes(iterations) @ weights.astype(np.float64))
    for name, most in MOST.items():
        i = list(SETTINGS).index(name)
        found[:, i] *= most / (most - start[:, i] + found[:, i])
    return found


def limits_of(grid: ModalGrid, bound: float) -> AdmmLimits:
    """Limits of a grid's case for a bound on |ω|, rad/s, and what makes them comparable."""
    case = grid.case
    by_bound = np.diag(grid.stiffness) * bound * grid.spacing
    unit = float(np.exp(np.log(np.minimum(grid.ramp, by_bound)).mean()))
    largest = float(np.maximum(np.abs(case.p_min), np.abs(case.p_max)).sum())
    return AdmmLimits(
        low=case.p_min,
        high=case.p_max,
        step=grid.ramp,
        bound=bound,
        is_tight=grid.coarse.is_tight,
        mass=grid.mass,
        unit=unit,
        price=unit / ((len(grid.knots) - 1) * largest),
        gain=filled_up(grid.gain),
        shape=filled_up(grid.shape.T).T.copy(),
    )


def filled_up(values: Floats) -> Array32:
    """Values of modes, (..., n_modes), in single precision, with zeros for modes that there are not.

    Loops over modes take vectors; one by one, seven that are left over would take longer than all vectors.
    """
    *shape, n = values.shape
    more = -n % VECTOR if n % VECTOR > LEFT_OVER else 0
    filled = np.zeros((*shape, n + more), np.float32)
    filled[..., :n] = values
    return filled


def mean_modes_of(grid: ModalGrid, linear: ModalLinearisation) -> MeanModes:
    """Modes of the mean stiffness along trajectories, in which powers weigh by inertia."""
    mean = grid.stiffness + np.einsum("k,bkgh->bgh", grid.shares, linear.stiffness)
    return mean_modes(mean, grid.mass, float(grid.network.m.mean()), grid.rate, float(grid.points[1]), POINTS)


class CompiledIterations:
    """The same function as `TorchIterations`, with its weights as an array; powers in float64."""

    def __init__(self, grid: ModalGrid, bound: float, nodes: np.ndarray, iterations: int) -> None:
        """Iterations for a bound on |ω|, rad/s."""
        self._grid, self._limits, modes = grid, limits_of(grid, bound), grid.modes
        self.settings = settings_of(nodes, iterations)
        self.settings[:, :PENALTIES] *= self._limits.price
        self.settings[0, 6] = 1.0  # the first copies are what the first schedule does
        self._modes = modes._replace(step=filled_up(modes.step), damping=filled_up(modes.damping))

    def __call__(self, start: Start, linear: ModalLinearisation, schedule: Array) -> Array:
        """Powers at the knots, from first ones, both (batch, n_knots, n_gen), pu."""
        grid, powers = self._grid, schedule.copy()
        taken = grid.stiffness.sum(axis=0), linear.stiffness.sum(axis=2)
        nominal, changes = (part @ grid.shape.T for part in taken)
        given = AdmmProblems(
            cost=start.problems.cost / start.scale[:, None],
            offset=filled_up(linear.offset),
            slack=linear.slack.astype(np.float32),
            slack_of_mode=(nominal + grid.between @ changes).astype(np.float32),
            change=filled_up(linear.change),
            state=filled_up(start.state),
            mean=mean_modes_of(grid, linear),
        )
        iterate(powers, given, self._limits, self._modes, self.settings)
        return powers


@compiled
def iterate(powers: Array, given: AdmmProblems, limits: AdmmLimits, modes: Modes, settings: Array) -> None:
    """Turn first schedules into answers by iterations of ADMM; see the top.

    An answer is the last schedule within its limits, or the first: where the last is not finite, or where
    the bound is loose and the first is better.

    Args:
        powers: (batch, n_knots, n_gen), pu; receives the answers.
        given: the problems.
        limits: of the case.
        modes: of the case.
        settings: of each iteration, (n_iterations, 8); the columns are those of `SETTINGS`.
    """
    (batch, n, n_gen), n_points = powers.shape, given.offset.shape[1]
    omega, p_slack = np.empty((n_points, n_gen), np.float32), np.empty(n_points, np.float32)
    gradient = np.empty((n, n_gen))
    # copies and duals
    bounded, moved = np.empty((2, n, n_gen)), np.empty((2, n, n_gen))
    speeds, slack = np.empty((2, n_points, n_gen), np.float32), np.empty((2, n_points))
    for b in range(batch):
        p = powers[b].copy()
        bounded[:], moved[:], speeds[:], slack[:] = 0.0, 0.0, 0.0, 0.0
        first = np.inf
        for i in range(len(settings)):
            _respond(p, given, b, limits, modes, omega, p_slack)
            if i == 0 and not limits.is_tight:
                first = _loss(p, omega, p_slack, given, b, limits, modes)
            _project_powers(p, given.cost[b], limits, settings[i], bounded, moved, gradient)
            _project_response(
                (omega, p_slack), (speeds, slack), given, b, limits, modes, settings[i], gradient
            )
            _improve(p, gradient, given, b, limits, settings[i])
        track(p.reshape(1, n, n_gen), limits.low, limits.high, limits.step)
        if not limits.is_tight:
            _respond(p, given, b, limits, modes, omega, p_slack)
            if not _loss(p, omega, p_slack, given, b, limits, modes) <= first:
                continue
        if np.isfinite(p).all():  # where the grid swings up, it may not be
            for j in range(n):
                copy_row(p[j], powers[b, j])


@inlined
def _project_powers(
    p: Array, cost: Array, limits: AdmmLimits, setting: Array, bounded: Array, moved: Array, gradient: Array
) -> None:
    """Copies and duals of powers and their changes; `gradient` receives that of cost and both, in powers."""
    (n, n_gen), relaxed = p.shape, setting[6]
    unit = limits.mass * limits.unit**2
    on_powers, on_moves = setting[0] / unit, setting[1] / unit
    per_powers, per_moves = 1.0 / on_powers, 1.0 / on_moves
    gradient[0] = 0.0
    for j in range(1, n):
        share = (0.5 if j == n - 1 else 1.0) / (n - 1)
        for g in range(n_gen):
            weight = on_powers[g]
            wanted = relaxed * p[j, g] + (1.0 - relaxed) * bounded[0, j, g] + bounded[1, j, g] * per_powers[g]
            kept = min(max(wanted, limits.low[g]), limits.high[g])
            bounded[0, j, g], bounded[1, j, g] = kept, weight * (wanted - kept)
            gradient[j, g] = share * cost[1 + g] + bounded[1, j, g] + weight * (p[j, g] - kept)
            weight = on_moves[g]
            change = p[j, g] - p[j - 1, g]
            wanted = relaxed * change + (1.0 - relaxed) * moved[0, j, g] + moved[1, j, g] * per_moves[g]
            kept = min(max(wanted, -limits.step[g]), limits.step[g])
            moved[0, j, g], moved[1, j, g] = kept, weight * (wanted - kept)
            force = moved[1, j, g] + weight * (change - kept)
            gradient[j, g] += force
            gradient[j - 1, g] -= force


@inlined
def _project_response(
    outcome: tuple[Array32, Array32],
    copies: tuple[Array32, Array],
    given: AdmmProblems,
    b: int,
    limits: AdmmLimits,
    modes: Modes,
    setting: Array,
    gradient: Array,
) -> None:
    """Copies and duals of ω and P_s; what they ask of powers is added to the gradient."""
    omega, p_slack = outcome
    speeds, slack = copies
    (n_points, n_gen), n, points = omega.shape, len(gradient), (len(omega) - 1) // (len(gradient) - 1)
    n_modes = limits.gain.shape[1]
    relaxed, tight = np.float32(setting[6]), np.float32(limits.bound * (1.0 - setting[7]))
    weight = np.float32(setting[2] / (limits.bound**2 * points))
    per_weight = np.float32(1.0) / weight
    on_omega, on_v = np.empty((n_points, n_gen), np.float32), np.empty((n_points, n_modes), np.float32)
    on_q, on_speed = np.zeros_like(on_v), np.empty_like(on_v)
    heavy, other = setting[3] / (limits.unit**2 * points), np.float32(1.0) - relaxed
    price, per_heavy = given.cost[b, 0] / heavy / (n_points - 1), 1.0 / heavy
    for k in range(n_points):
        for g in range(n_gen):
            here = omega[k, g]
            wanted = relaxed * here + other * speeds[0, k, g] + speeds[1, k, g] * per_weight
            kept = min(max(wanted, -tight), tight)
            speeds[0, k, g], speeds[1, k, g] = kept, weight * (wanted - kept)
            on_omega[k, g] = speeds[1, k, g] + weight * (here - kept)
        own = 0.5 * price if k == 0 or k == n_points - 1 else price
        drawn = setting[6] * p_slack[k] + (1.0 - setting[6]) * slack[0, k] + slack[1, k] * per_heavy
        least = max(drawn - own, 0.0) + min(drawn + own, 0.0)
        slack[0, k], slack[1, k] = least, heavy * (drawn - least)
        force = np.float32(slack[1, k] + heavy * (p_slack[k] - least))
        for m in range(n_gen):
            on_q[k, m] = -force * given.slack_of_mode[b, k, m]
    np.dot(on_omega, limits.shape.T, on_speed)
    swing_adjoint(modes, given.change[b], on_q, on_speed, on_v)
    on_knots = np.zeros((n, n_modes), np.float32)
    for j in range(n - 1):
        for i in range(points):
            later = np.float32(i / points)
            for m in range(n_modes):
                on_knots[j, m] += (np.float32(1.0) - later) * on_v[j * points + i, m]
                on_knots[j + 1, m] += later * on_v[j * points + i, m]
    for m in range(n_modes):
        on_knots[n - 1, m] += on_v[n_points - 1, m]
    asked = np.dot(on_knots, limits.gain.T)
    for j in range(n):
        for g in range(n_gen):
            gradient[j, g] += asked[j, g]


@inlined
def _improve(
    p: Array, gradient: Array, given: AdmmProblems, b: int, limits: AdmmLimits, setting: Array
) -> None:
    """Minimise the quadratic model around a schedule, in the modes of the mean stiffness."""
    points = (given.offset.shape[1] - 1) // (len(p) - 1)
    per_unit = 1.0 / limits.unit**2
    weights = np.empty(4)
    weights[0], weights[1] = setting[0] * per_unit, setting[1] * per_unit
    weights[2] = setting[2] * setting[4] / (limits.bound**2 * points)
    weights[3] = setting[3] * setting[5] * per_unit / points
    modes, change = given.mean.powers[b], np.empty_like(p)
    modal_change(given.mean.maps[b], given.mean.outputs[b], weights, np.dot(gradient, modes), change)
    step = np.dot(change, modes.T)
    for j in range(p.shape[0]):
        for g in range(p.shape[1]):
            p[j, g] += step[j, g]


@inlined
def _loss(
    p: Array, omega: Array32, p_slack: Array32, given: AdmmProblems, b: int, limits: AdmmLimits, modes: Modes
) -> float:
    """Cost as a part of `Start.scale`, and the penalty; see `torch_iterations.judged`."""
    cost, penalty, (n, n_gen), n_points = 0.0, 0.0, p.shape, len(p_slack)
    for j in range(n):
        for g in range(n_gen):
            share = 0.5 if j == 0 or j == n - 1 else 1.0
            cost += share * given.cost[b, 1 + g] * p[j, g] / (n - 1)
    for k in range(n_points):
        share = 0.5 if k == 0 or k == n_points - 1 else 1.0
        cost += share * given.cost[b, 0] * abs(p_slack[k]) / (n_points - 1)
        for g in range(n_gen):
            if abs(omega[k, g]) > limits.bound:
                excess = abs(omega[k, g]) / limits.bound - 1.0
                bent = min(excess, STRAIGHT)
                penalty += excess + (excess - 0.5 * bent) * bent / DOUBLING
    return float(cost + PRICE * penalty * 2.0 * modes.half)


@inlined
def _respond(
    powers: Array,
    given: AdmmProblems,
    b: int,
    limits: AdmmLimits,
    modes: Modes,
    omega: Array32,
    p_slack: Array32,
) -> None:
    """What a schedule does: ω (n_points, n_gen) and P_s (n_points,); see `ModalGrid.respond`."""
    (n, n_gen), n_points = powers.shape, len(p_slack)
    n_modes, points = limits.gain.shape[1], (n_points - 1) // (n - 1)
    force = np.empty((n_points, n_modes), np.float32)
    q, speed = np.empty_like(force), np.empty_like(force)
    at_knots = np.dot(powers.astype(np.float32), limits.gain)
    for m in range(n_modes):
        q[0, m], speed[0, m] = given.state[b, 0, m], given.state[b, 1, m]
        force[n_points - 1, m] = given.offset[b, n_points - 1, m] + at_knots[n - 1, m]
    for j in range(n - 1):
        for i in range(points):
            later = np.float32(i / points)
            for m in range(n_modes):
                here = at_knots[j, m] + later * (at_knots[j + 1, m] - at_knots[j, m])
                force[j * points + i, m] = given.offset[b, j * points + i, m] + here
    swing(modes, given.change[b], force, q, speed)
    np.dot(speed, limits.shape, omega)
    for k in range(n_points):
        drawn = given.slack[b, k]
        for m in range(n_gen):
            drawn -= given.slack_of_mode[b, k, m] * q[k, m]
        p_slack[k] = drawn
