"""A fixed number of first-order steps on the condensed problem, for many instances at once.

The condensed problem is the linear program over the knots

    min Σ c_i P_i + c_s |P_s|   with   y = A p + a = (P_s, ω / bound, ramps, powers)

where A is the same for all instances. ADMM splits it into a least-squares step, whose matrix is
factorised once, and a step that treats each component of y alone (Boyd et al. 2011). The last
answer passes through the follower, so that bounds, ramps and P_0 hold after any number of steps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.ramp_follower import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.koopman import CondensedRollout, Koopman, free_response

Array32 = NDArray[np.float32]
#: Spacing of the points at which P_s and ω are taken, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.2
#: Penalty weights of the split: P_s (pu), ω (in units of its bound), ramps and powers (pu).
WEIGHTS = {"p_slack": 0.1, "omega": 0.003, "ramp": 1.0, "power": 1.0}
#: Length of the dual step; ADMM converges below (1 + √5) / 2 (Fortin and Glowinski 1983).
DUAL_STEP = 1.6
#: The bound is tightened by this fraction: about the error of the model.
MARGIN = 0.01
#: How much worse an answer counts per relative unit of its largest excess of |ω|, relative to its cost.
EXCESS_PRICE = 1.0


class Refiner:
    """The condensed problem of a case, regime and time grid, factorised."""

    def __init__(self, case: Case, model: Koopman, regime: str, grid: Array, knots: Array) -> None:
        """Condense and factorise."""
        self.case, self.network, self.model, self.grid = case, Network(case), model, grid
        n_gen, n_knots = len(case.generators), len(knots)
        self.stride = coarse_stride(model.dt_s, len(grid) - 1, SPACING_S)
        condensed = CondensedRollout.make(case, model, grid, knots, self.stride)
        gamma = condensed.gamma
        self.hat_weights, self.quadrature_weights = condensed.hat_weights, condensed.quadrature_weights
        root = {name: math.sqrt(value) for name, value in WEIGHTS.items()}
        self.omega_bound = case.omega_bound(regime)
        self.step = case.ramp * (knots[1] - knots[0])  # largest change between two knots, (n_gen,), pu
        self.n_slack, n_free = gamma.shape[1], (n_knots - 1) * n_gen  # rows of y that are P_s; free powers
        unit = np.eye(n_knots * n_gen)
        rows = np.concatenate(
            [
                gamma[n_gen] * root["p_slack"],
                gamma[:n_gen].reshape(-1, n_knots * n_gen) / self.omega_bound * root["omega"],
                (unit[n_gen:] - unit[:-n_gen]) * root["ramp"],
                unit[n_gen:] * root["power"],
            ]
        )
        free = rows[:, n_gen:]
        self.rows = rows.astype(np.float32)  # A, each row weighted, (n_rows, n_knots n_gen)
        self.solve = np.linalg.inv(free.T @ free).astype(np.float32)  # for the knots after the first
        high = np.concatenate(
            [
                np.full(n_gen * self.n_slack, (1.0 - MARGIN) * root["omega"]),
                np.tile(self.step, n_knots - 1) * root["ramp"],
                np.tile(case.p_max, n_knots - 1) * root["power"],
            ]
        )
        low = -high
        low[-n_free:] = np.tile(case.p_min, n_knots - 1) * root["power"]
        #: Limits of the other rows, (n_rows - n_slack,).
        self.low, self.high = low.astype(np.float32), high.astype(np.float32)

    def __call__(self, inputs: StackedInstances, p_gen: Array, steps: int) -> Array:
        """Improve schedules.

        Args:
            inputs: the instances.
            p_gen: powers at the knots to start from, (batch, n_knots, n_gen), pu.
            steps: how many.

        Returns:
            As `p_gen`; an instance whose steps led to nothing better keeps what it had.
        """
        batch, n_knots, n_gen = p_gen.shape
        n, n_rows = self.n_slack, len(self.rows)
        free = coarse_free_response(self.network, self.model, inputs, self.grid, self.stride)
        slack_unit = math.sqrt(WEIGHTS["p_slack"])
        fixed = np.zeros((batch, n_rows), dtype=np.float32)
        fixed[:, :n] = free[:, n_gen] * slack_unit
        fixed[:, n : n * (1 + n_gen)] = free[:, :n_gen].reshape(batch, -1) * (
            math.sqrt(WEIGHTS["omega"]) / self.omega_bound
        )
        fixed += p_gen[:, 0].astype(np.float32) @ self.rows[:, :n_gen].T
        rows = self.rows[:, n_gen:]
        # costs per grid point, relative to the instance's own: the scale the weights are chosen for
        unit = 1.0 / (np.maximum(inputs.cost.sum(axis=1), 1e-9) * len(self.grid))
        cost = (self.hat_weights[1:, None] * inputs.cost[:, None, 1:]).reshape(batch, -1) * unit[:, None]
        pull = cost.astype(np.float32) @ self.solve
        shrink = (inputs.cost[:, :1] * self.quadrature_weights * (unit[:, None] / slack_unit)).astype(
            np.float32
        )
        project = rows @ self.solve
        x = p_gen[:, 1:].reshape(batch, -1).astype(np.float32)
        y = x @ rows.T + fixed
        z, dual = y.copy(), np.zeros_like(y)
        for _ in range(steps):
            q = y + dual
            z[:, :n] = q[:, :n] - np.clip(q[:, :n], -shrink, shrink)
            np.clip(q[:, n:], self.low, self.high, out=z[:, n:])
            x = (z - dual - fixed) @ project - pull
            y = x @ rows.T + fixed
            dual += DUAL_STEP * (y - z)
        refined = np.concatenate([p_gen[:, :1], x.reshape(batch, n_knots - 1, n_gen)], axis=1)
        track(refined, self.case.p_min, self.case.p_max, self.step)
        better = self._merit(inputs, fixed, refined) < self._merit(inputs, fixed, p_gen)
        return np.where(better[:, None, None], refined, p_gen)

    def _merit(self, inputs: StackedInstances, fixed: Array32, p_gen: Array) -> Array:
        """Cost, raised in proportion to the largest excess of |ω| over its bound, shape (batch,)."""
        batch, _, n_gen = p_gen.shape
        n = self.n_slack
        free = p_gen[:, 1:].reshape(batch, -1).astype(np.float32)
        y = free @ self.rows[: n * (1 + n_gen), n_gen:].T + fixed[:, : n * (1 + n_gen)]
        p_slack = y[:, :n] / math.sqrt(WEIGHTS["p_slack"])
        omega = np.abs(y[:, n:]).max(axis=1) / math.sqrt(WEIGHTS["omega"])
        generators = (np.einsum("bkg,k->bg", p_gen, self.hat_weights) * inputs.cost[:, 1:]).sum(axis=1)
        cost = generators + inputs.cost[:, 0] * (np.abs(p_slack) @ self.quadrature_weights)
        return np.asarray(cost * (1.0 + EXCESS_PRICE * np.maximum(omega - (1.0 - 0.5 * MARGIN), 0.0)))


def coarse_stride(dt_s: float, steps: int, spacing_s: float) -> int:
    """Largest divisor of the number of steps that keeps to a spacing."""
    most = max(1, round(spacing_s / dt_s))
    return next(s for s in range(most, 0, -1) if steps % s == 0)


def coarse_free_response(
    network: Network, model: Koopman, inputs: StackedInstances, grid: Array, stride: int
) -> Array32:
    """`koopman.free_response` of instances, (batch, n_gen + 1, n_coarse), float32."""
    p_load = inputs.p_load(grid)
    theta = network.power_flow(inputs.p_initial, p_load[:, 0])
    if inputs.delta.any():
        theta[:, network.generators] += inputs.delta
        theta, _ = network.solve_loads(theta, network.load_injections(p_load[:, 0]))
    psi = model.observables(network, theta, inputs.omega, p_load[:, 0])
    return free_response(model, psi, p_load, stride).astype(np.float32)
