"""Problems on the time grid: of instances, and drawn for training without files.

Those drawn are of the benchmark's kind, or like those of a closed loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance

#: Points of the time grid per interval between knots.
POINTS = 4
#: Which part of drawn problems is of the closed loop's kind.
OPERATING = 0.25
#: Their fluctuation: standard deviation as a part of the nominal load, and decay, s.
FLUCTUATION, DECAY_S = 5e-4, 20.0


@dataclass(frozen=True, eq=False)
class Problems:
    """Problems of one case; like `StackedInstances`, but for the loads."""

    load: Array  # on the time grid, (batch, n_points, n_load), pu
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu
    delta: Array  # θ(0) less the equilibrium of P_0 and the initial loads, (batch, n_gen), rad
    omega: Array  # ω(0), (batch, n_gen), rad/s

    @staticmethod
    def of(case: Case, instances: Sequence[Instance], points: Array) -> Problems:
        """Sample instances on a time grid, (n_points,), s.

        Raises:
            PowerFlowError: an instance gives angles at t = 0, but there is no equilibrium to compare with.
        """
        given = StackedInstances.of(case, instances)
        load = sampled(given.load, points)
        return Problems(load, given.cost, given.p_initial, given.delta, given.omega)

    def __len__(self) -> int:
        return len(self.load)

    def __getitem__(self, rows: slice) -> Problems:
        return Problems(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def time_grid(knots: Array) -> Array:
    """The knots and equidistant points between them, (n_points,), s."""
    return np.linspace(knots[0], knots[-1], POINTS * (len(knots) - 1) + 1)


def sampled(segments: Array, points: Array) -> Array:
    """Loads on a time grid, (batch, n_points, n_load), pu; see `load_segments`."""
    values = np.empty((len(segments), len(points), segments.shape[1]))
    sample_loads(segments, float(points[1]), values)
    return values


def draw(case: Case, bound: float, points: Array, count: int, generator: np.random.Generator) -> Problems:
    """Draw problems.

    The benchmark's kind is the sampler's (`problem.sampling`). The closed loop's kind has a second ramp in
    each load, a decaying fluctuation, powers nearer to the static dispatch, and a state within the bound
    that is no equilibrium.

    Args:
        case: gives the ranges.
        bound: of |ω|, rad/s.
        points: the time grid, (n_points,), s.
        count: how many.
        generator: of random numbers.
    """
    n_gen, ranges = len(case.generators), case.sampling
    operating = generator.random(count) < OPERATING
    cost = _uniform(generator, ranges.cost, (count, 1 + n_gen))
    load = _ramps(case, points, count, generator)
    chosen = np.flatnonzero(operating)
    more = _ramps(case, points, len(chosen), generator)
    load[chosen] += more - more[:, :1]
    noise = generator.standard_normal((len(chosen), 1, len(case.loads))) * FLUCTUATION * case.load_nominal
    load[chosen] += noise * (np.exp(-points / DECAY_S) - 1.0)[None, :, None]
    p_opt = merit_order(case, cost[:, 1:], cost[:, 0], load[:, 0])
    perturbation = _uniform(generator, ranges.perturbation, (count, n_gen))
    perturbation *= np.where(operating, generator.random(count), 1.0)[:, None]
    omega = _uniform(generator, ranges.omega_rad_per_s, (count, n_gen))
    delta = np.where(operating[:, None], 0.5 * bound * generator.standard_normal((count, n_gen)), 0.0)
    inside = np.clip(bound * generator.uniform(-1.0, 1.0, (count, n_gen)), -0.05, 0.05)
    omega = np.where(operating[:, None] & (generator.random((count, 1)) < 0.7), inside, omega)
    delta = np.clip(delta, -0.02, 0.02)
    return Problems(load, cost, p_opt - 0.5 * (p_opt - case.p_nominal) * perturbation, delta, omega)


def _ramps(case: Case, points: Array, count: int, generator: np.random.Generator) -> Array:
    """Loads that ramp once, (count, n_points, n_load), pu; in case/2 none changes its sign."""
    ranges, shape = case.sampling, (count, len(case.loads))
    draws = [_ramp(case, shape, generator)]
    if case.schema_ != "ded-bench/case/1":
        for _ in range(50):
            initial, start, duration, rate = draws[-1]
            last = initial + rate * np.clip(ranges.horizon_s - start, 0.0, duration)
            wrong = np.minimum(initial * case.load_nominal, last * case.load_nominal) < 0
            if not wrong.any():
                break
            again = _ramp(case, shape, generator)
            draws.append(tuple(np.where(wrong, new, old) for new, old in zip(again, draws[-1], strict=True)))
    initial, start, duration, rate = draws[-1]
    none = np.zeros(shape)
    pieces = (
        (none, initial, none),
        (start, initial, rate),
        (start + duration, initial + rate * duration, none),
    )
    return sampled(np.stack([np.stack(piece, axis=-1) for piece in pieces], axis=2), points)


def _ramp(case: Case, shape: tuple[int, int], generator: np.random.Generator) -> tuple[Array, ...]:
    ranges = case.sampling
    spread = (-ranges.load_relative, ranges.load_relative)
    initial = case.load_nominal * (1.0 + _uniform(generator, spread, shape))
    start, duration = (_uniform(generator, ends, shape) for ends in (ranges.start_s, ranges.duration_s))
    low, high = case.load_rate
    rate = low + (high - low) * generator.random(shape)
    rate *= np.where(generator.random(shape) < 0.5, -1.0, 1.0)
    return initial, start, duration, rate * (generator.random(shape) >= ranges.rate_zero_probability)


def _uniform(generator: np.random.Generator, ends: tuple[float, float], shape: tuple[int, ...]) -> Array:
    return np.asarray(generator.uniform(ends[0], ends[1], shape))


@compiled
def sample_loads(segments: Array, spacing: float, values: Array) -> None:
    """Loads on the time grid; around a kink as means weighted by hat functions, which keep the area.

    Args:
        segments: see `load_segments`, (batch, n_load, n_segments, 3).
        spacing: of the time grid, s.
        values: receives the loads, (batch, n_points, n_load), pu.
    """
    for b in range(len(values)):
        for i in range(values.shape[2]):
            path, last = segments[b, i], len(segments[b, i]) - 1
            at = 0
            for k in range(values.shape[1]):
                while at < last and path[at + 1, 0] <= k * spacing:
                    at += 1
                values[b, k, i] = path[at, 1] + path[at, 2] * (k * spacing - path[at, 0])
            for s in range(1, len(path)):
                start, bend = path[s, 0], path[s, 2] - path[s - 1, 2]
                before = int(start / spacing) if start < spacing * values.shape[1] else values.shape[1]
                for k in range(max(before, 1), min(before + 2, values.shape[1] - 1)):
                    u = (k * spacing - start) / spacing
                    mean = (max(u + 1.0, 0.0) ** 3 - 2.0 * max(u, 0.0) ** 3) / 6.0
                    values[b, k, i] += bend * spacing * (mean - max(u, 0.0))
