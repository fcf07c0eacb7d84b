"""Problems as arrays, drawn for training without files: the benchmark's kind, and those of a closed loop."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.admm.start_kernels import sample_paths
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, LoadPoints, LoadRamp

#: Which part of drawn problems is of the closed loop's kind.
OPERATING = 0.25
#: Their fluctuation: standard deviation as a part of the nominal load, and decay, s.
FLUCTUATION, DECAY_S = 5e-4, 20.0


#: A segment that no path reaches: it starts later than any horizon ends, s.
NEVER = [1e30, 0.0, 0.0]


@dataclass(frozen=True, eq=False)
class Problems:
    """Instances of one case, at fine points."""

    load: Array  # (batch, n_fine, n_load), pu
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu
    delta: Array  # θ(0) less the equilibrium of P_0 and the initial loads, (batch, n_gen), rad
    omega: Array  # ω(0), (batch, n_gen), rad/s

    @staticmethod
    def of(case: Case, instances: Sequence[Instance], fine: Array) -> Problems:
        """Stack instances.

        Raises:
            PowerFlowError: an instance gives angles at t = 0, but there is no equilibrium to compare with.
        """
        machines = (case.slack, *case.generators)
        return Problems(
            load=sampled(case, instances, fine),
            cost=np.array([[i.cost[bus] for bus in machines] for i in instances]),
            p_initial=np.array([i.p_initial(case) for i in instances]),
            delta=np.array([_deviation(case, i) for i in instances]),
            omega=np.array([i.omega_initial(case) for i in instances]),
        )

    def __len__(self) -> int:
        return len(self.load)

    def __getitem__(self, rows: slice) -> Problems:
        return Problems(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def _deviation(case: Case, instance: Instance) -> Array:
    theta = instance.theta_initial(case)
    if theta is None:
        return np.zeros(len(case.generators))
    network = Network(case)
    p_load = instance.p_load(case, np.zeros(1))[0]
    equilibrium = network.power_flow(instance.p_initial(case), p_load)
    return np.asarray(theta - equilibrium[network.generators])


def averaged(values: Array, every: int) -> Array:
    """Means weighted by the hat function of every so many-th point.

    Args:
        values: (batch, n, n_columns); both ends are kept as they are.
        every: how many points make one.
    """
    hat = np.minimum(np.arange(1, 2 * every), np.arange(1, 2 * every)[::-1]) / every**2
    found, last = values[:, ::every].copy(), values.shape[1] - every
    found[:, 1:-1] = 0.0
    for k, weight in enumerate(hat, start=1):
        found[:, 1:-1] += weight * values[:, k : last + k - every : every]
    return found


def segments_of(load: LoadRamp | LoadPoints) -> list[float]:
    """(start, value there, slope) of each linear piece of a load's path, one after another."""
    if isinstance(load, LoadRamp):
        initial, start, duration, rate = load.initial, load.start, load.duration, load.rate
        return [0.0, initial, 0.0, start, initial, rate, start + duration, initial + rate * duration, 0.0]
    path: list[float] = []
    for (t, p), (t_next, p_next) in itertools.pairwise(load.points):
        path += [t, p, (p_next - p) / (t_next - t)]
    return path


def sampled(case: Case, instances: Sequence[Instance], fine: Array) -> Array:
    """Loads of instances at the fine points, (batch, n_fine, n_load), pu."""
    paths = [segments_of(i.load[bus]) for i in instances for bus in case.loads]
    longest = max(map(len, paths), default=0)
    flat = [number for path in paths for number in path + NEVER * ((longest - len(path)) // 3)]
    segments = np.array(flat).reshape(len(instances), len(case.loads), longest // 3, 3)
    values = np.empty((len(instances), len(fine), len(case.loads)))
    sample_paths(segments, float(fine[1]), values)
    return values


def draw(case: Case, bound: float, fine: Array, count: int, generator: np.random.Generator) -> Problems:
    """Draw problems.

    The benchmark's kind is the sampler's (`problem.sampling`). The closed loop's kind has a second ramp in
    each load, a decaying fluctuation, powers nearer to the static dispatch, and a state within the bound
    that is no equilibrium.

    Args:
        case: gives the ranges.
        bound: of |ω|, rad/s.
        fine: fine points, (n_fine,), s.
        count: how many.
        generator: of random numbers.
    """
    n_gen, ranges = len(case.generators), case.sampling
    operating = generator.random(count) < OPERATING
    cost = _uniform(generator, ranges.cost, (count, 1 + n_gen))
    load = _ramps(case, fine, count, generator)
    chosen = np.flatnonzero(operating)
    more = _ramps(case, fine, len(chosen), generator)
    load[chosen] += more - more[:, :1]
    noise = generator.standard_normal((len(chosen), 1, len(case.loads))) * FLUCTUATION * case.load_nominal
    load[chosen] += noise * (np.exp(-fine / DECAY_S) - 1.0)[None, :, None]
    p_opt = merit_order(case, cost[:, 1:], cost[:, 0], load[:, 0])
    perturbation = _uniform(generator, ranges.perturbation, (count, n_gen))
    perturbation *= np.where(operating, generator.random(count), 1.0)[:, None]
    omega = _uniform(generator, ranges.omega_rad_per_s, (count, n_gen))
    delta = np.where(operating[:, None], 0.5 * bound * generator.standard_normal((count, n_gen)), 0.0)
    inside = np.clip(bound * generator.uniform(-1.0, 1.0, (count, n_gen)), -0.05, 0.05)
    omega = np.where(operating[:, None] & (generator.random((count, 1)) < 0.7), inside, omega)
    delta = np.clip(delta, -0.02, 0.02)
    return Problems(load, cost, p_opt - 0.5 * (p_opt - case.p_nominal) * perturbation, delta, omega)


def _ramps(case: Case, fine: Array, count: int, generator: np.random.Generator) -> Array:
    """Loads that ramp once, (count, n_fine, n_load), pu; in case/2 none changes its sign."""
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
    segments = np.stack([np.stack(piece, axis=-1) for piece in pieces], axis=2)
    values = np.empty((count, len(fine), shape[1]))
    sample_paths(segments, float(fine[1]), values)
    return values


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
