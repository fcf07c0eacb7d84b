"""ADMM on the set-points of an island, linearised at its nominal point; the dispatch that it starts from.

Set-points x at the knots, outputs y = y_0 + Φ (x - x_0) along a simulation of x_0, and

    min  price · c · P_m   with   |y| ≤ bound,   limits, ramps and transfers of x

by the alternating direction method of multipliers with over-relaxation (Stellato and others, OSQP, 2020).
Φ and the penalties are the same for all instances, so that one matrix is inverted once. With no price it
finds set-points near the given ones that keep the bounds.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import knot_points, transfer_room
from ded_bench.methods.ramp_follower import track
from ded_bench.plants.detailed.coarse import CoarsePlant, CoarseStart
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance

Array32 = NDArray[np.float32]

#: Distance of points, s, about. Swings of shipped islands are slower than 1.5 Hz.
SPACING_S = 0.25
#: Parts of the bounds on the mean frequency and on swings that are left to errors of the model.
MEAN_MARGIN, SWING_MARGIN = 0.3, 0.1
#: Transfers are kept by so much, pu, and ramps by this part of them: what iterations leave open.
TRANSFER_MARGIN, RAMP_MARGIN = 2e-3, 0.02
#: Of squares of set-points, beside the penalties.
REGULARISATION = 1e-4
#: Part of the bound on swings that the first schedule's way to the merit order takes.
PACE = 0.7
#: Over-relaxation.
RELAXATION = 1.6
#: Names of the learned settings: logarithms of the penalties of outputs, limits and ramps; of the price.
SETTINGS = ("mean", "swing", "limit", "ramp", "price")


@dataclass(frozen=True, eq=False)
class IslandProblem:
    """One instance, as iterations see it."""

    instance: Instance
    begun: CoarseStart
    p_initial: Array  # (n_gen,), pu
    cost: Array  # (n_gen,)
    room: Array  # what transfers leave at the knots after the first, (n_intervals, n_transfers), pu
    start: Array  # the schedule to start from, (n_knots, n_gen), pu


@dataclass(frozen=True, eq=False)
class Found:
    """What a schedule leads to, in coarse steps."""

    schedule: Array  # (n_knots, n_gen), pu
    outputs: Array  # of the bounds, in parts of them, (n_rows,)
    cost: float
    excess: float  # over the bounds, as a part of them; negative within


class IslandGrid:
    """What is the same for all instances of a case, a regime and a horizon."""

    def __init__(self, case: Case, regime: str, horizon_s: float) -> None:
        """Linearise; InputError where the plant has no coarse steps that fit."""
        if case.slack is not None or case.plant_name != "detailed":
            raise InputError(f"case {case.id}", "plant", "is no island of detailed machines")
        self.case, self.bounds, self.plant = case, case.bounds(regime), plant_of(case)
        self.knots = case.knot_times(horizon_s)
        between = max(round(float(self.knots[1]) / SPACING_S), 1)
        self.points = np.linspace(0.0, horizon_s, between * (len(self.knots) - 1) + 1)
        self.coarse = CoarsePlant(self.plant.system, float(self.points[1]))  # type: ignore[attr-defined]
        part = self.points[:, None] / self.knots[1] - np.arange(len(self.knots))
        self.hat = np.maximum(1.0 - np.abs(part), 0.0)
        n_gen = len(case.generators)
        inputs = np.einsum("tk,gi->tgki", self.hat[:, 1:], np.eye(n_gen)).reshape(len(self.points), n_gen, -1)
        omega, delivered = self.coarse.response(inputs)
        weight = np.full(len(self.points), self.points[1])
        weight[[0, -1]] /= 2.0
        self.weight = weight / horizon_s
        #: Mean delivered powers by set-points, (n_gen, n_columns).
        self.delivered = np.einsum("t,tgi->gi", self.weight, delivered)
        outputs = np.einsum("og,tgi->toi", self.bounds.matrix, omega)
        self.rows = self._chosen(outputs / self.bounds.limit[:, None])
        is_mean = np.array([kind != "relative" for kind in self.bounds.kinds])
        #: Which rows are of the mean frequency.
        self.is_mean = self._chosen(np.broadcast_to(is_mean, (len(self.points), len(is_mean))))
        self.room = 1.0 - np.where(self.is_mean, MEAN_MARGIN, SWING_MARGIN)
        self.step = case.ramp * float(self.knots[1])
        #: Swings in parts of their bound while machines ramp by 1 pu/s, (n_relative, n_gen), s/pu.
        ramps = (self.knots[1:, None, None] * np.eye(n_gen)).reshape(-1, n_gen)
        self.ramping = (outputs[-1] / self.bounds.limit[:, None])[~is_mean] @ ramps

    def _chosen(self, outputs: Array) -> Array:
        """Outputs (n_points, n_out, ...) where they are limited, (n_rows, ...)."""
        always, last = outputs[1:, ~self.bounds.at_end], outputs[-1, self.bounds.at_end]
        return np.concatenate([always.reshape(-1, *outputs.shape[2:]), last])

    def ask(self, instance: Instance) -> IslandProblem:
        """Read an instance.

        Raises:
            InputError, SimulationError: it has no start.
        """
        case, p_initial = self.case, instance.p_initial(self.case)
        _, by_load, most = case.transfer_rows
        p_load = instance.p_load(case, self.knots)
        share = case.p_nominal / case.p_nominal.sum()
        served = p_initial + np.outer((p_load[0] - p_load).sum(axis=1), share)
        cost = instance.cost_gen(case)
        moved = self._merit_order(cost, served.sum(axis=1), most - p_load @ by_load.T) - served
        pace = np.abs(self.ramping @ moved[-1]).max() / PACE
        moved *= np.minimum(self.knots / max(pace, float(self.knots[1])), 1.0)[:, None]
        start = self.plant.set_points_delivering(served + moved, float(self.knots[1]))
        room = np.empty((len(self.knots) - 1, 0))
        if case.transfers:
            room = transfer_room(case, instance, knot_points(self.knots, instance.dt_s)) - TRANSFER_MARGIN
        begun = self.coarse.begin(instance)
        return IslandProblem(instance, begun, p_initial, cost, room, self.within(start, p_initial, room))

    def _merit_order(self, cost: Array, demand: Array, room: Array) -> Array:
        """Cheapest powers, whatever losses they cause; transfers are kept; (n_knots, n_gen)."""
        powers = self._raised(cost, demand, np.ones(len(cost), dtype=bool))
        for by_machine, most in zip(self.case.transfer_rows[0], room.T, strict=True):
            group, beyond = by_machine > 0.0, powers @ by_machine > most
            for part, total in ((group, most), (~group, demand - most)):
                powers[np.ix_(beyond, part)] = self._raised(cost, total, part)[beyond]
        return powers

    def _raised(self, cost: Array, demand: Array, part: Array) -> Array:
        """Some machines raised from their lower limits, one after another, (n_knots, n_part)."""
        low, high, order = self.case.p_min[part], self.case.p_max[part], np.argsort(cost[part])
        reach = (high - low)[order]
        below = np.cumsum(reach) - reach
        powers = np.tile(low, (len(demand), 1))
        powers[:, order] += np.clip((demand - low.sum())[:, None] - below, 0.0, reach)
        return powers

    def within(self, powers: Array, p_initial: Array, room: Array) -> Array:
        """Schedules that keep limits and ramps, and transfers as far as these let them; (n_knots, n_gen)."""
        by_machine = self.case.transfer_rows[0]
        kept = np.clip(powers, self.case.p_min, self.case.p_max)
        kept[0] = p_initial
        for group, most in zip(by_machine, room.T, strict=True):
            beyond = np.maximum(kept[1:] @ group - most - TRANSFER_MARGIN / 2.0, 0.0)
            above = np.maximum(kept[1:] - self.case.p_min, 0.0) * group
            kept[1:] -= above * (beyond / np.maximum(above.sum(axis=1), 1e-12))[:, None]
        track(kept[None], self.case.p_min, self.case.p_max, self.step)
        return kept

    def follow(self, asked: IslandProblem, schedule: Array) -> Found:
        """Simulate in coarse steps; SimulationError where the network has no voltages any more."""
        omega, delivered = self.coarse.follow(asked.begun, self.hat @ schedule)
        outputs = self._chosen(omega @ self.bounds.matrix.T / self.bounds.limit)
        cost = float(self.weight @ delivered @ asked.cost)
        return Found(schedule, outputs, cost, float(np.abs(outputs).max()) - 1.0)


class IslandIterations:
    """Iterations with given settings, see `SETTINGS`."""

    def __init__(self, grid: IslandGrid, settings: Sequence[float] | Array) -> None:
        self.grid = grid
        mean, swing, limit, ramp, self.price = np.exp(np.asarray(settings, dtype=np.float64)).tolist()
        n_gen, n = len(grid.case.generators), grid.rows.shape[1]
        #: Roots of penalties: rows and limits are scaled by them.
        self.by_row = np.sqrt(np.where(grid.is_mean, mean, swing)).astype(np.float32)
        self.by_limit, self.by_ramp = np.sqrt(limit), (np.sqrt(ramp) / grid.step).astype(np.float32)
        self.groups = (np.sqrt(limit) * grid.case.transfer_rows[0]).astype(np.float32)
        rows = grid.rows * self.by_row[:, None]
        change = np.eye(n) - np.eye(n, k=-n_gen)
        steps = change * np.tile(self.by_ramp.astype(np.float64), n // n_gen)[:, None]
        groups = np.kron(np.eye(n // n_gen), self.groups)
        normal = rows.T @ rows + steps.T @ steps + groups.T @ groups
        normal += (limit + REGULARISATION) * np.eye(n)
        inverse = np.linalg.inv(normal)
        self.rows, self.inverse = rows.astype(np.float32), inverse.astype(np.float32)
        #: Set-points by the costs of machines.
        self.pull = (inverse @ grid.delivered.T).astype(np.float32)

    def __call__(
        self,
        asked: IslandProblem,
        near: Found,
        iterations: int,
        priced: bool,
        dual: list[Array32] | None = None,
    ) -> tuple[Array, list[Array32]]:
        """Iterate from what was simulated.

        Args:
            asked: the instance.
            near: a schedule and its outputs.
            iterations: how many.
            priced: whether costs count.
            dual: to go on from; None: zero.

        Returns:
            Set-points, (n_knots, n_gen), pu, and the dual variables.
        """
        grid, (n_knots, n_gen) = self.grid, near.schedule.shape
        x0 = near.schedule[1:].astype(np.float32)
        by_row, by_limit, by_ramp = self.by_row, np.float32(self.by_limit), self.by_ramp
        first = asked.p_initial.astype(np.float32)
        spread = max(float(np.ptp(asked.cost)), 1e-9)
        pull = self.pull @ (asked.cost * (self.price / spread if priced else 0.0)).astype(np.float32)
        free = (near.outputs * by_row).astype(np.float32) - self.rows @ x0.ravel()
        # Outputs, set-points, their changes, transfers: stacked, each with its scale.
        room = (grid.room * by_row).astype(np.float32)
        ramp = np.float32(1.0 - RAMP_MARGIN) * by_ramp * grid.step
        start = first * by_ramp
        low = [-room - free, by_limit * grid.case.p_min, -ramp, -np.inf]
        high = [room - free, by_limit * grid.case.p_max, ramp, by_limit * asked.room]
        low, high = ([np.asarray(part, dtype=np.float32) for part in side] for side in (low, high))

        def images(x: Array32) -> list[Array32]:
            change = x * by_ramp
            change[1:] -= x[:-1] * by_ramp
            change[0] -= start
            return [self.rows @ x.ravel(), by_limit * x, change, x @ self.groups.T]

        at = images(x0)
        dual = [np.zeros_like(a) for a in at] if dual is None else list(dual)
        z = []
        for i, a in enumerate(at):
            z.append(np.clip(a + dual[i], low[i], high[i]))
            dual[i] = dual[i] + a - z[i]
        x = x0
        for _ in range(iterations):
            y, u, r, t = (b - d for b, d in zip(z, dual, strict=True))
            r[0] += start
            right = by_limit * u + r * by_ramp + t @ self.groups
            right[:-1] -= r[1:] * by_ramp
            x = (self.inverse @ (y @ self.rows + right.ravel()) - pull).reshape(n_knots - 1, n_gen)
            for i, a in enumerate(images(x)):
                ahead = RELAXATION * a + (1.0 - RELAXATION) * z[i] + dual[i]
                z[i] = np.clip(ahead, low[i], high[i])
                dual[i] = ahead - z[i]
        found = np.concatenate([near.schedule[:1], x.astype(np.float64)])
        return grid.within(found, asked.p_initial, asked.room), dual


@functools.lru_cache(maxsize=8)
def grid_of(case: Case, regime: str, horizon_s: float) -> IslandGrid:
    """The grid of a case, regime and horizon, made once."""
    return IslandGrid(case, regime, horizon_s)
