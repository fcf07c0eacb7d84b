"""The last step of `ded-dpc`: where |ω| would exceed its bound, the least change of powers that mends it.

The linearised grid tells what a schedule does to ω between the knots too, within a hundredth of the bound
of what the true system does (docs/model.md). Only where |ω| comes nearer than that to the bound is anything
changed: damped Gauss-Newton steps lead the powers to where ω stays below. Each passes through the follower,
so that bounds, ramps and P_0 hold after any number of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.methods.ramp_follower import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled
from ded_bench.surrogates.koopman import CondensedRollout
from ded_bench.surrogates.linear import linear_model

#: Points at which ω is looked at, for each interval between knots.
PARTS = 10
#: The bound is tightened by this fraction, the error of the linearisation; from t = 0, where the state is
#: given and nothing can be changed, it grows to that over one interval.
MARGIN = 0.01
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
            np.ascontiguousarray(linear.lift[:, case.n_bus + Network(case).generators]),
            np.ascontiguousarray(of_change[:, :n_gen]),
            np.ascontiguousarray(of_change[:, n_gen:]),
        )
        #: Of |ω| at the points, (n_points,), rad/s.
        self.limit = case.omega_bound(regime) * (1.0 - MARGIN * np.minimum(points / knots[1], 1.0))
        gamma = CondensedRollout.make(case, linear, points, knots).gamma[:n_gen]
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
                psi[:] = push
            for g in range(n_gen):
                omega[b, g, k] = psi[g]
                exceeds |= abs(psi[g]) > limit[k]
    return exceeds


@compiled
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
