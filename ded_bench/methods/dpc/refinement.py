"""What may follow the network of `ded-dpc`: steps that refine its answer, and the least change that mends it.

**Refined** is for many instances at once, by a fixed number of first-order steps on the condensed problem,
the linear program over the knots

    min Σ c_i P_i + c_s |P_s|   with   y = A p + a = (P_s, ω / bound, ramps, powers)

where A is the same for all instances. ADMM splits it into a least-squares step, whose matrix is
factorised once, and a step that treats each component of y alone (Boyd et al. 2011). The last
answer passes through the follower, so that bounds, ramps and P_0 hold after any number of steps.

**Mended** is where |ω| would exceed its bound. The linearised grid tells what a schedule does to ω between
the knots too, within a hundredth of the bound of what the true system does (studies/dpc.md). Only where |ω|
comes nearer than that to the bound is anything changed: damped Gauss-Newton steps lead the powers to where ω
stays below. Each passes through the follower.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ded_bench.methods.knots import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Array32, largest_divisor
from ded_bench.surrogates.koopman import CondensedRollout, Koopman, free_response
from ded_bench.surrogates.linear import by_angles, linear_model

#: Spacing of the points at which P_s and ω are taken, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.2
#: Penalty weights of the split: P_s (pu), ω (in units of its bound), ramps and powers (pu).
WEIGHTS = {"p_slack": 0.1, "omega": 0.003, "ramp": 1.0, "power": 1.0}
#: Length of the dual step; ADMM converges below (1 + √5) / 2 (Fortin and Glowinski 1983).
DUAL_STEP = 1.6
#: The bound is tightened by this fraction: about the error of the model, and of the linearised grid. Where it
#: is mended, from t = 0, where the state is given and nothing can be changed, it grows to that over one
#: interval.
MARGIN = 0.01
#: How much worse an answer counts per relative unit of its largest excess of |ω|, relative to its cost.
EXCESS_PRICE = 1.0


class Refiner:
    """The condensed problem of a case, regime and time grid, factorised."""

    def __init__(self, case: Case, model: Koopman, regime: str, grid: Array, knots: Array) -> None:
        """Condense and factorise."""
        self.case, self.model, self.grid = case, model, grid
        n_gen, n_knots = len(case.generators), len(knots)
        self.stride = largest_divisor(len(grid) - 1, round(SPACING_S / model.dt_s))
        condensed = CondensedRollout.make(model, grid, knots, self.stride)
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
        free = coarse_free_response(self.model, inputs, self.grid, self.stride)
        slack_unit, omega_unit = math.sqrt(WEIGHTS["p_slack"]), math.sqrt(WEIGHTS["omega"])
        fixed = np.zeros((batch, n_rows), dtype=np.float32)
        fixed[:, :n] = free[:, n_gen] * slack_unit
        fixed[:, n : n * (1 + n_gen)] = free[:, :n_gen].reshape(batch, -1) * (omega_unit / self.omega_bound)
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


def coarse_free_response(model: Koopman, inputs: StackedInstances, grid: Array, stride: int) -> Array32:
    """`koopman.free_response` of instances, (batch, n_gen + 1, n_coarse), float32."""
    network, p_load = model.network, inputs.p_load(grid)
    theta = network.power_flow(inputs.p_initial, p_load[:, 0])
    if inputs.delta.any():
        theta[:, network.generators] += inputs.delta
        theta, _ = network.solve_loads(theta, network.load_injections(p_load[:, 0]))
    psi = model.observables(theta, inputs.omega, p_load[:, 0])
    return free_response(model, psi, p_load, stride).astype(np.float32)


#: Points at which ω is looked at, for each interval between knots.
PARTS = 10
#: Steps aim below the tightened bound by this fraction of it, so that few of them are needed.
AIM = 0.003
#: Steps are damped by this part of the most that powers can do to ω at one point (squares, summed over them).
DAMPING = 0.1
#: Most steps; on validation instances one to four, hardly ever more than ten.
STEPS = 30


class OmegaModel(NamedTuple):
    """What ω does under powers and loads linear between points; deviations from rest advance by `advance`."""

    advance: Array  # (n_psi, n_psi), over one point; ω is the first n_gen of the deviations
    of_delta: Array  # (n_psi, n_gen), per rad of δθ at t = 0
    of_power: Array  # (n_psi, n_gen), per pu that a power changes from one point to the next
    of_load: Array  # (n_psi, n_load), likewise


class BoundKeeper:
    """Changes schedules that would take |ω| beyond its bound."""

    def __init__(self, case: Case, regime: str, knots: Array) -> None:
        """Condense the linearisation at the nominal point; knots are equidistant."""
        n_gen = len(case.generators)
        points = np.linspace(knots[0], knots[-1], PARTS * (len(knots) - 1) + 1)
        self.case, self.spacing_s = case, float(points[1])
        linear = linear_model(case, self.spacing_s)
        of_change = linear.g - linear.b
        self.model = OmegaModel(
            linear.k,
            by_angles(case),
            np.ascontiguousarray(of_change[:, :n_gen]),
            np.ascontiguousarray(of_change[:, n_gen:]),
        )
        #: Of |ω| at the points, (n_points,), rad/s.
        self.limit = case.omega_bound(regime) * (1.0 - MARGIN * np.minimum(points / knots[1], 1.0))
        gamma = CondensedRollout.make(linear, points, knots).gamma[:n_gen]
        #: ω at the points by powers at the knots, (n_gen, n_points, n_knots, n_gen), rad/s per pu.
        self.of_power = gamma.reshape(n_gen, len(points), len(knots), n_gen)
        self.damping = DAMPING * float((self.of_power[:, :, 1:] ** 2).sum(axis=(2, 3)).max())
        self.step = case.ramp * (knots[1] - knots[0])  # largest change between two knots, (n_gen,), pu

    def __call__(self, inputs: StackedInstances, p_gen: Array) -> Array:
        """Schedules that keep the bound, as far as the linearised grid tells and the limits let them.

        Args:
            inputs: the instances.
            p_gen: powers at the knots, (batch, n_knots, n_gen), pu, within bounds and ramps.

        Returns:
            As `p_gen`; the same where nothing is exceeded.
        """
        by_generator = np.ascontiguousarray(p_gen.swapaxes(1, 2))
        omega = np.empty((*by_generator.shape[:2], len(self.limit)))
        state = np.concatenate([inputs.delta, inputs.omega], axis=1)
        if not predict(inputs.load, state, by_generator, self.model, self.limit, self.spacing_s, omega):
            return p_gen
        kept = p_gen.copy()
        for b in np.flatnonzero((np.abs(omega) > self.limit).any(axis=(1, 2))):
            kept[b] = self._mended(omega[b], p_gen[b])
        return kept

    def _mended(self, omega: Array, p_gen: Array) -> Array:
        """The schedule, of all that the steps lead to, whose squared excess is least.

        Args:
            omega: at the points, (n_gen, n_points), rad/s.
            p_gen: powers at the knots, (n_knots, n_gen), pu.
        """
        aim, best, least = (1.0 - AIM) * self.limit, p_gen, self._excess(omega)
        tried, now = p_gen, omega
        damping = self.damping * np.eye(p_gen[1:].size)
        for _ in range(STEPS):
            if least == 0.0:
                break
            g, k = np.nonzero(np.abs(now) > aim)
            rows = self.of_power[g, k, 1:].reshape(len(g), -1) * np.sign(now[g, k])[:, None]
            excess = np.abs(now[g, k]) - aim[k]
            change = np.linalg.solve(rows.T @ rows + damping, rows.T @ excess)
            tried = tried.copy()
            tried[1:] -= change.reshape(tried[1:].shape)
            track(tried[None], self.case.p_min, self.case.p_max, self.step)
            now = omega + np.tensordot(self.of_power, tried - p_gen, 2)
            if (left := self._excess(now)) < least:
                best, least = tried, left
        return best

    def _excess(self, omega: Array) -> float:
        return float((np.maximum(np.abs(omega) - self.limit, 0.0) ** 2).sum())


@compiled
def predict(
    load: Array, state: Array, p_gen: Array, model: OmegaModel, limit: Array, spacing: float, omega: Array
) -> bool:
    """What the linearised grid does to ω under schedules.

    Args:
        load: segments of a batch, see `StackedInstances`.
        state: (δθ, ω) at t = 0, (batch, 2 n_gen), rad and rad/s.
        p_gen: (batch, n_gen, n_knots), pu.
        model: the linearised grid.
        limit: of |ω| at the points, (n_points,), rad/s; a whole number of points makes an interval of knots.
        spacing: of the points, s.
        omega: receives ω at the points, (batch, n_gen, n_points), rad/s.

    Returns:
        Whether any |ω| exceeds its limit.
    """
    n_psi, n_gen = model.of_power.shape
    n_points, parts, exceeds = len(limit), (len(limit) - 1) // (p_gen.shape[2] - 1), False
    pushes, psi, power = np.empty((n_points, n_psi)), np.empty(n_psi), np.empty(n_psi)
    for b in range(len(p_gen)):
        _load_pushes(load[b], model.of_load, spacing, pushes)
        for i in range(n_psi):
            psi[i] = state[b, n_gen + i] if i < n_gen else 0.0
            for g in range(n_gen):
                psi[i] += model.of_delta[i, g] * state[b, g]
        for k in range(n_points):
            if k and (k - 1) % parts == 0:
                j = (k - 1) // parts
                power[:] = 0.0
                for g in range(n_gen):
                    change = (p_gen[b, g, j + 1] - p_gen[b, g, j]) / parts
                    for i in range(n_psi):
                        power[i] += model.of_power[i, g] * change
            if k:
                push = pushes[k]
                for i in range(n_psi):
                    push[i] += power[i]
                    for m in range(n_psi):
                        push[i] += model.advance[i, m] * psi[m]
                copy_row(push, psi)
            for g in range(n_gen):
                omega[b, g, k] = psi[g]
                exceeds |= abs(psi[g]) > limit[k]
    return exceeds


@inlined
def _load_pushes(load: Array, of_load: Array, spacing: float, pushes: Array) -> None:
    """What changes of an instance's loads from one point to the next add to the state, (n_points, n_psi)."""
    pushes[:] = 0.0
    for i in range(len(load)):
        segments, following = load[i], 0
        before = segments[0, 1]
        for k in range(len(pushes)):
            t = k * spacing
            while following < len(segments) and segments[following, 0] <= t:
                following += 1
            value = segments[following - 1, 1] + segments[following - 1, 2] * (t - segments[following - 1, 0])
            if value != before:
                for n in range(len(of_load)):
                    pushes[k, n] += of_load[n, i] * (value - before)
                before = value
