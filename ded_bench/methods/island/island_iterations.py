"""ADMM on the set-points of an island, linearised at its nominal point; the dispatch that it starts from.

Set-points x at the knots, outputs y = y_0 + Φ (x - x_0) along a simulation of x_0, and

    min  price · c · P_m   with   |y| ≤ bound,   limits, ramps and transfers of x

by the alternating direction method of multipliers with over-relaxation (Stellato and others, OSQP, 2020).
Φ and the penalties are the same for all instances, so that one matrix is inverted once. Swings forget within
seconds what they were moved by: their rows are those of one knot, moved in time. With no price the iterations
find set-points near the given ones that keep the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ded_bench.methods.island.block_factors import Factors, factored, solve
from ded_bench.methods.knots import knot_points, track, transfer_room
from ded_bench.plants.detailed.coarse import CoarsePlant, CoarseStart
from ded_bench.plants.detailed.power_system import DetailedState
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, inlined
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import Array32

#: Distance of rows for swings, s, about: those of shipped islands are slower than 1.5 Hz.
SPACING_S = 0.25
#: What a knot does to swings is left out after so long, s, or earlier, once this part of it is left.
REMEMBERED_S, FORGOTTEN = 12.0, 0.035
#: Transfers are kept by so much, pu, and ramps by this part of them: what iterations leave open.
TRANSFER_MARGIN, RAMP_MARGIN = 2e-3, 0.02
#: Of set-points, pu: 1.5 kW, and half the size in archives.
RESOLUTION = 2.0**-16
#: Of squares of set-points, beside the penalties; over-relaxation.
REGULARISATION, RELAXATION = 1e-4, 1.6
#: Part of the bound on swings that the first schedule's way to the merit order takes.
PACE = 0.7
#: Names of the learned settings, logarithms: penalties of outputs, limits and ramps; the price; parts of the
#: bounds on the mean frequency and on swings that are left to errors of the model.
SETTINGS = ("mean", "swing", "limit", "ramp", "price", "mean margin", "swing margin")


@dataclass(frozen=True, eq=False)
class IslandProblem:
    """One instance, as iterations see it."""

    begun: CoarseStart
    p_initial: Array  # (n_gen,), pu
    cost: Array  # (n_gen,)
    room: Array  # what transfers leave at the knots after the first, (n_intervals, n_transfers), pu
    start: Array  # the schedule to start from, (n_knots, n_gen), pu


@dataclass(frozen=True, eq=False)
class Found:
    """What a schedule leads to, in coarse steps."""

    schedule: Array  # (n_knots, n_gen), pu
    mean: Array  # mean frequency at the knots after the first, in parts of its bound, (n_intervals,)
    swings: Array  # in parts of their bound, at the points of an interval, (n_intervals, n_swings)
    excess: float  # over the bounds, as a part of them; negative within


class Maps(NamedTuple):
    """The linear answer to set-points at the knots after the first; n_columns of them, knot after knot."""

    mean: Array32  # mean frequency at the knots, (n_intervals, n_columns)
    swing: Array32  # swings in an interval by the knots of the last n_memory, (n_memory n_gen, n_swings)
    back: Array32  # the same, transposed, by the knots of the next n_memory: (n_swings, n_memory n_gen)


class IslandGrid:
    """What is the same for all instances of a case, a regime and a horizon."""

    def __init__(self, case: Case, regime: str, horizon_s: float, substeps: int = 1) -> None:
        """Linearise; `substeps` are those of simulations between two rows. InputError: the plant has none."""
        self.case, self.plant, bounds = case, plant_of(case), case.bounds(regime)
        self.knots = case.knot_times(horizon_s)
        self.substeps, self.between = substeps, substeps * max(round(float(self.knots[1]) / SPACING_S), 1)
        self.points = np.linspace(0.0, horizon_s, self.between * (len(self.knots) - 1) + 1)
        self.coarse = CoarsePlant(self.plant.system, float(self.points[1]), single=True)  # type: ignore[attr-defined]
        part = self.points[:, None] / self.knots[1] - np.arange(len(self.knots))
        self.hat = np.maximum(1.0 - np.abs(part), 0.0)
        self.step = case.ramp * float(self.knots[1])
        self.weight = np.trapezoid(np.eye(len(self.points)), dx=self.points[1]) / horizon_s
        rows = [i for kind in ("mean", "relative") for i, own in enumerate(bounds.kinds) if own == kind]
        #: The mean frequency and swings in parts of their bounds, by frequencies, (1 + n_relative, n_gen).
        self.outputs = bounds.matrix[rows] / bounds.limit[rows, None]
        #: The bound on the mean at the end, as a part of that before.
        before = bounds.limit[rows[0]]
        self.last = float(bounds.limit[bounds.at_end].min(initial=before) / before)
        self.maps = self._maps()

    def _maps(self) -> Maps:
        n, n_gen, each = len(self.knots) - 1, len(self.case.generators), np.eye(len(self.case.generators))
        inputs = np.einsum("tk,gi->tgki", self.hat[:, 1:], each).reshape(len(self.points), n_gen, -1)
        omega, delivered = self.coarse.response(inputs)
        #: Mean delivered powers by set-points, (n_gen, n_columns).
        self.delivered = np.einsum("t,tgi->gi", self.weight, delivered)
        mean = np.einsum("g,tgi->ti", self.outputs[0], omega[self.between :: self.between])
        omega, _ = self.coarse.response(self.points[:, None, None] * each, agc=False)
        #: Swings while machines ramp by 1 pu/s, (n_relative, n_gen), s/pu.
        self.ramping = self.outputs[1:] @ omega[-1]
        omega, _ = self.coarse.response(self.hat[:, 1][:, None, None] * each, agc=False)
        at_rows = omega[self.substeps :: self.substeps]
        swings = np.einsum("og,tgi->ito", self.outputs[1:], at_rows).reshape(n_gen, n, -1)
        size = np.linalg.norm(swings, axis=(0, 2)) ** 2
        memory = int(np.count_nonzero(np.cumsum(size[::-1])[::-1] > FORGOTTEN**2 * size.sum()))
        swings = swings[:, : min(memory, round(REMEMBERED_S / float(self.knots[1])))]
        recent = swings[:, ::-1].swapaxes(0, 1).reshape(-1, swings.shape[2])
        parts = mean, recent, swings.T.reshape(swings.shape[2], -1)
        return Maps(*(np.ascontiguousarray(part, dtype=np.float32) for part in parts))

    def ask(self, instance: Instance, state: DetailedState | None = None) -> IslandProblem:
        """Read an instance, which begins in its own state or another.

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
        start = self.within(start, p_initial, room)
        return IslandProblem(self.coarse.begin(instance, state), p_initial, cost, room, start)

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
        low, high, order = self.case.p_min[part], self.case.p_max[part], np.argsort(cost[part], kind="stable")
        reach = (high - low)[order]
        below = np.cumsum(reach) - reach
        powers = np.tile(low, (len(demand), 1))
        powers[:, order] += np.clip((demand - low.sum())[:, None] - below, 0.0, reach)
        return powers

    def within(self, powers: Array, p_initial: Array, room: Array) -> Array:
        """Schedules that keep limits and ramps, and transfers as far as these let them; (n_knots, n_gen)."""
        kept = np.clip(powers, self.case.p_min, self.case.p_max)
        kept[0] = p_initial
        for group, most in zip(self.case.transfer_rows[0], room.T, strict=True):
            beyond = np.maximum(kept[1:] @ group - most - TRANSFER_MARGIN / 2.0, 0.0)
            above = np.maximum(kept[1:] - self.case.p_min, 0.0) * group
            kept[1:] -= above * (beyond / np.maximum(above.sum(axis=1), 1e-12))[:, None]
        track(kept[None], self.case.p_min, self.case.p_max, self.step)
        return kept

    def follow(self, asked: IslandProblem, schedule: Array, linear: bool = False) -> Found:
        """Simulate in coarse steps; SimulationError where the network has no voltages any more."""
        omega, _ = self.coarse.follow(asked.begun, self.hat @ schedule, linear)
        outputs = omega @ self.outputs.T
        mean, swings = outputs[self.between :: self.between, 0], outputs[self.substeps :: self.substeps, 1:]
        most = float(np.abs(outputs).max())
        return self._found(schedule, mean, swings.reshape(len(schedule) - 1, -1), most)

    def moved(self, near: Found, schedule: Array) -> Found:
        """What a schedule leads to by the linear answer to its distance from another one."""
        change = (schedule - near.schedule)[1:].astype(np.float32)
        mean = near.mean + self.maps.mean @ change.ravel()
        swings = near.swings + swings_by(self.maps, change)
        most = max(float(np.abs(mean).max()), float(np.abs(swings).max()))
        return self._found(schedule, mean, swings, most)

    def _found(self, schedule: Array, mean: Array, swings: Array, most: float) -> Found:
        return Found(schedule, mean, swings, max(most, abs(float(mean[-1])) / self.last) - 1.0)


class IslandIterations:
    """Iterations with given penalties and price, the first of `SETTINGS`."""

    def __init__(self, grid: IslandGrid, settings: Sequence[float] | Array) -> None:
        self.grid = grid
        mean, swing, limit, ramp, self.price = np.exp(np.asarray(settings, float)).tolist()
        self.penalties = np.array([mean, swing, limit, ramp, limit], dtype=np.float32)
        near, phi = squares(grid, swing, limit, ramp), grid.maps.mean.astype(np.float64)
        self.factors, answer = factored(near, phi, 1.0 / mean, len(grid.maps.swing), grid.delivered.T)
        #: Set-points by the costs of machines.
        self.pull = answer.astype(np.float32)

    def __call__(
        self, asked: IslandProblem, near: Found, iterations: int, margins: Array, dual: Array32 | None = None
    ) -> tuple[Array, Array32]:
        """Iterate from a schedule.

        Args:
            asked: the instance.
            near: a schedule and what it leads to.
            iterations: how many.
            margins: the last of `SETTINGS`.
            dual: to go on from; None: zero.

        Returns:
            Set-points, (n_knots, n_gen), pu; the dual variables.
        """
        grid, case = self.grid, self.grid.case
        n, n_gen = len(grid.knots) - 1, len(case.generators)
        spread = max(float(np.ptp(asked.cost)), 1e-9)
        pull = self.pull @ (asked.cost * (self.price / spread)).astype(np.float32)
        mean = np.full(n, max(1.0 - margins[0], 0.0))
        mean[-1] *= grid.last
        by_transfer = case.transfer_rows[0].astype(np.float32)
        step, ones = grid.step.astype(np.float32), np.ones((n, n_gen))
        offset = [
            near.mean,
            near.swings,
            near.schedule[1:],
            np.diff(near.schedule, axis=0) / grid.step,
            near.schedule[1:] @ by_transfer.T,
        ]
        swing = np.full_like(near.swings, max(1.0 - margins[1], 0.0))
        ramp = (1.0 - RAMP_MARGIN) * ones
        low = [-mean, -swing, case.p_min * ones, -ramp, np.full_like(asked.room, -np.inf)]
        high = [mean, swing, case.p_max * ones, ramp, asked.room]
        flat = (np.concatenate([p.ravel() for p in part]).astype(np.float32) for part in (offset, low, high))
        offset32, low32, high32 = flat
        dual = np.zeros_like(offset32) if dual is None else dual.copy()
        change = np.zeros((n, n_gen), dtype=np.float32)
        given = Iterated(self.factors, pull, self.penalties, by_transfer, step, offset32, low32, high32)
        iterate(grid.maps, given, change, dual, iterations)
        found = near.schedule.copy()
        found[1:] = np.round((found[1:] + change) / RESOLUTION) * RESOLUTION
        return grid.within(found, asked.p_initial, asked.room), dual


def squares(grid: IslandGrid, swing: float, limit: float, ramp: float) -> Array:
    """Of all rows but the mean's, times their penalties, summed, (n_columns, n_columns)."""
    n_gen, n = len(grid.case.generators), len(grid.knots) - 1
    by_lag = grid.maps.swing.astype(np.float64).reshape(-1, n_gen, grid.maps.swing.shape[1])[::-1]
    identity, by_transfer = np.eye(n), grid.case.transfer_rows[0]
    own = (limit + REGULARISATION) * np.eye(n_gen) + limit * by_transfer.T @ by_transfer
    change = identity - np.eye(n, k=-1)
    found: Array = np.kron(identity, own) + np.kron(change.T @ change, np.diag(ramp / grid.step**2))
    blocks = found.reshape(n, n_gen, n, n_gen)
    for k in range(n):
        for lag in range(min(len(by_lag), n - k)):
            count = min(len(by_lag) - lag, n - k - lag)
            block = swing * np.tensordot(by_lag[:count], by_lag[lag : lag + count], ((0, 2), (0, 2)))
            blocks[k + lag, :, k] += block
            if lag:
                blocks[k, :, k + lag] += block.T
    return found


class Iterated(NamedTuple):
    """What iterations are given. Rows: mean at knots, swings, set-points, ramps in parts, transfers."""

    factors: Factors
    pull: Array32  # of costs, (n_columns,), pu
    penalties: Array32  # of the five kinds of rows
    by_transfer: Array32  # (n_transfers, n_gen)
    step: Array32  # largest changes between knots, (n_gen,), pu
    offset: Array32  # rows at the given schedule, (n_rows,)
    low: Array32
    high: Array32


@compiled
def swings_by(maps: Maps, change: Array32) -> Array32:
    """Swings by changes of set-points (n, n_gen), (n, n_swings)."""
    n, n_gen = change.shape
    memory = len(maps.swing) // n_gen
    recent = np.zeros((n, memory * n_gen), dtype=np.float32)
    for k in range(n):
        for lag in range(min(memory, k + 1)):
            for g in range(n_gen):
                recent[k, (memory - 1 - lag) * n_gen + g] = change[k - lag, g]
    swings: Array32 = np.dot(recent, maps.swing)
    return swings


@inlined
def _set_rows(maps: Maps, given: Iterated, change: Array32, rows: Array32) -> None:
    """All rows, (n_rows,), by changes of set-points."""
    n, n_gen = change.shape
    mean, swings = np.dot(maps.mean, change.reshape(n * n_gen)), swings_by(maps, change)
    flows, n_swings = np.dot(change, given.by_transfer.T), swings.shape[1]
    at = n + n * n_swings
    transfers, ramps = at + 2 * n * n_gen, at + n * n_gen
    for k in range(n):
        rows[k] = mean[k] + given.offset[k]
        for i in range(n_swings):
            row = n + k * n_swings + i
            rows[row] = swings[k, i] + given.offset[row]
        for g in range(n_gen):
            row = k * n_gen + g
            rows[at + row] = change[k, g] + given.offset[at + row]
            ramp = change[k, g] - change[k - 1, g] if k else change[k, g]
            rows[ramps + row] = ramp / given.step[g] + given.offset[ramps + row]
        for i in range(len(given.by_transfer)):
            row = transfers + k * len(given.by_transfer) + i
            rows[row] = flows[k, i] + given.offset[row]


@inlined
def _pulled(maps: Maps, given: Iterated, rows: Array32, shape: tuple[int, int]) -> Array32:
    """The transpose of `_set_rows`, each kind of rows times its penalty, (n_columns,)."""
    (n, n_gen), n_swings = shape, maps.swing.shape[1]
    at, memory = n + n * n_swings, len(maps.swing) // n_gen
    transfers, ramps = at + 2 * n * n_gen, at + n * n_gen
    asked = np.dot(rows[transfers:].reshape(n, len(given.by_transfer)), given.by_transfer)
    swings = np.dot(rows[n:at].reshape(n, n_swings), maps.back)
    found: Array32 = np.dot(rows[:n], maps.mean)
    for k in range(n):
        for g in range(n_gen):
            row = k * n_gen + g
            ramp = rows[ramps + row] - rows[ramps + row + n_gen] if k + 1 < n else rows[ramps + row]
            swing = np.float32(0.0)
            for lag in range(min(memory, n - k)):
                swing += swings[k + lag, lag * n_gen + g]
            pull = given.penalties[0] * found[row] + given.penalties[1] * swing
            pull += given.penalties[2] * rows[at + row]
            pull += given.penalties[3] * ramp / given.step[g]
            found[row] = pull + given.penalties[4] * asked[k, g]
    return found


@compiled
def iterate(maps: Maps, given: Iterated, change: Array32, dual: Array32, count: int) -> None:
    """Iterate `count` times; set-points less the given ones (n, n_gen) and dual variables are changed."""
    relaxed, (n, n_gen) = np.float32(RELAXATION), change.shape
    kept, rows = np.empty_like(dual), np.empty_like(dual)
    for i in range(len(dual)):
        ahead = given.offset[i] + dual[i]
        kept[i] = min(max(ahead, given.low[i]), given.high[i])
        dual[i] = ahead - kept[i]
    for _ in range(count):
        for i in range(len(dual)):
            rows[i] = kept[i] - dual[i] - given.offset[i]
        found = solve(given.factors, _pulled(maps, given, rows, change.shape))
        for k in range(n):
            for g in range(n_gen):
                change[k, g] = found[k * n_gen + g] - given.pull[k * n_gen + g]
        _set_rows(maps, given, change, rows)
        for i in range(len(dual)):
            ahead = relaxed * rows[i] + (np.float32(1.0) - relaxed) * kept[i] + dual[i]
            kept[i] = min(max(ahead, given.low[i]), given.high[i])
            dual[i] = ahead - kept[i]
