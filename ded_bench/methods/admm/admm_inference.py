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

import numpy as np

from ded_bench.methods.admm.admm_kernels import AdmmLimits, AdmmProblems, iterate
from ded_bench.methods.admm.modal_grid import ModalGrid, ModalLinearisation, Start
from ded_bench.methods.admm.problems import POINTS
from ded_bench.methods.admm.quadratic_kernels import mean_modes
from ded_bench.problem.case import Array

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


def weight_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the weights: the same on every grid."""
    return {"nodes": (NODES, len(SETTINGS))}


def starting_settings(iterations: int) -> Array:
    """Settings where training starts, (iterations, 8)."""
    return np.stack([np.geomspace(*ends, iterations) for ends in SETTINGS.values()], axis=1)


def between_nodes(iterations: int) -> Array:
    """Linear interpolation from the nodes to all iterations, (iterations, NODES)."""
    at = np.linspace(0.0, NODES - 1.0, iterations)
    return np.stack([np.interp(at, np.arange(NODES), row) for row in np.eye(NODES)], axis=1)


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
        mass=grid.mass,
        unit=unit,
        price=unit / ((len(grid.knots) - 1) * largest),
        gain=grid.gain.astype(np.float32),
        shape=grid.shape.astype(np.float32),
    )


def mean_modes_of(grid: ModalGrid, linear: ModalLinearisation) -> tuple[Array, Array, Array]:
    """Modes of the mean stiffness along trajectories, in which powers weigh by inertia.

    Returns:
        Powers by column (batch, n_gen, n_modes), `interval_maps` (batch, POINTS + 1, 2, 4, n_modes), and
        `outputs` of `modal_change` (batch, 2, n_modes).
    """
    n = len(grid.mass)
    mean = grid.stiffness + np.tensordot(linear.stiffness, grid.shares, axes=(1, 0))
    into, maps, outputs = (np.empty((len(mean), *shape)) for shape in ((n, n), (POINTS + 1, 2, 4, n), (2, n)))
    inertia, h = float(grid.network.m.mean()), float(grid.points[1])
    mean_modes(mean, grid.mass, inertia, grid.rate, h, into, maps, outputs)
    return into, maps, outputs


class CompiledIterations:
    """The same function as `TorchIterations`, with its weights as an array; powers in float64."""

    def __init__(self, grid: ModalGrid, bound: float, nodes: np.ndarray, iterations: int) -> None:
        """Iterations for a bound on |ω|, rad/s."""
        self._grid, self._limits, modes = grid, limits_of(grid, bound), grid.modes
        self.settings = settings_of(nodes, iterations)
        self.settings[:, :PENALTIES] *= self._limits.price
        self._modes = modes._replace(
            step=modes.step.astype(np.float32), damping=modes.damping.astype(np.float32)
        )

    def __call__(self, start: Start, linear: ModalLinearisation, schedule: Array) -> Array:
        """Powers at the knots, from first ones, both (batch, n_knots, n_gen), pu."""
        grid, powers = self._grid, schedule.copy()
        taken = grid.stiffness.sum(axis=0), linear.stiffness.sum(axis=2)
        nominal, changes = (part @ grid.shape.T for part in taken)
        into, maps, outputs = mean_modes_of(grid, linear)
        given = AdmmProblems(
            cost=start.problems.cost / start.scale[:, None],
            offset=linear.offset.astype(np.float32),
            slack=linear.slack.astype(np.float32),
            slack_of_mode=(nominal + grid.between @ changes).astype(np.float32),
            change=linear.change.astype(np.float32),
            state=start.state.astype(np.float32),
            mean_modes=into,
            mean_maps=maps,
            mean_outputs=outputs,
        )
        iterate(powers, given, self._limits, self._modes, self.settings)
        return powers
