"""The sampler: instances (paper, Table III), and scenarios of the closed loop.

All draws are plain uniforms in a fixed order, from a generator of its own for each instance or scenario, so
that a file is the same on every machine. What cannot be used is drawn again from the same generator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Initial, Instance, LoadPoints, LoadRamp
from ded_bench.problem.quantities import Array, Range
from ded_bench.problem.scenario import Fluctuation, Scenario, ScenarioLoad, ScenarioRamp

#: Master seeds of data that must never overlap the benchmark's instances (docs/grids.md).
POLICY_SEED, CERTIFICATE_SEED, KOOPMAN_SEED = 1_000_000, 2_000_000, 3_000_000
#: Between the seeds of policies: instances on which choices are made, so that test instances only score.
VALIDATION_SEED = POLICY_SEED + 500_000
#: Scenarios are drawn from master seeds from here on.
SCENARIO_SEED = 4_000_000
DECIMALS = 9
#: How often one is drawn before the case's ranges are taken to be wrong; a scenario's most horizons.
ATTEMPTS, MOST_HORIZONS = 1000, 600
#: Scenarios of a case, and their duration, s, unless told otherwise.
SCENARIOS, DURATION_S = 20, 300.0
#: Loads of scenarios stay within this part of their nominal value, but for fluctuation and drift.
LOAD_RANGE = 0.3
#: Standard deviations of announced starts (s) and rates (relative), and how many ramps are not announced.
START_ERROR_S, RATE_ERROR, UNANNOUNCED = 1.5, 0.15, 0.2
#: The fluctuation's standard deviation as a part of the nominal load, and its times, s.
FLUCTUATION, STEP_S, DECAY_S, SMOOTH_S = 0.0005, 0.5, 20.0, 2.0
#: Digits of the fluctuation after the point, in pu: a tenth of a thousandth of its standard deviation.
FLUCTUATION_DECIMALS = 8
#: On islands its points are farther apart, s: files of grids with many loads stay small.
ISLAND_STEP_S = 5.0
#: Duration of an hour, s, whose ramps leave loads within a narrower range, and which drift beside that by up
#: to a part of their nominal value; points of the drift, and the time within which it returns, s.
HOUR_S, HOUR_RANGE, DRIFT, DRIFT_STEP_S, DRIFT_DECAY_S = 3600.0, 0.1, 0.05, 60.0, 1200.0
#: A drawn instance as the case's plant can serve it, or None (`plants.plant.servable`).
Servable = Callable[[Case, Instance], Instance | None]


def sample_instances(
    case: Case, master: int, count: int, first: int = 0, servable: Servable | None = None
) -> Iterator[Instance]:
    """Draw instances `first` to `first + count - 1` of a master seed (see `drawn_with_redraws`)."""
    return (instance for instance, _ in drawn_with_redraws(case, master, count, first, servable))


def sample_instance(case: Case, master: int, index: int, servable: Servable | None = None) -> Instance:
    """Draw instance `index` of master seed `master` (see `drawn_with_redraws`)."""
    return next(sample_instances(case, master, 1, index, servable))


def drawn_with_redraws(
    case: Case, master: int, count: int, first: int = 0, servable: Servable | None = None
) -> Iterator[tuple[Instance, int]]:
    """Draw instances `first` to `first + count - 1` of a master seed, each with how often it drew again.

    An instance's generator is seeded by (master, index). Drawn again are a load that changes its sign (in
    case/2; some of the paper's 9-bus loads do), and an instance that is not servable. On an island powers
    at t = 0 are balanced by `servable`.

    Args:
        servable: tells which instances can be served, and balances them; None: all of them, as drawn.

    Raises:
        InputError: the case's ranges leave hardly anything to draw.
    """
    for index in range(first, first + count):
        generator = np.random.default_rng(np.random.SeedSequence([master, index]))
        redraws = 0
        for _ in range(ATTEMPTS):
            instance, repeated = _draw(case, master, index, generator)
            redraws += repeated
            if (served := servable(case, instance) if servable else instance) is not None:
                yield served, redraws
                break
            redraws += 1
        else:
            raise InputError(f"case {case.id}", "sampling", f"{ATTEMPTS} draws in a row cannot be served")


def _draw(case: Case, master: int, index: int, generator: np.random.Generator) -> tuple[Instance, int]:
    """Draw an instance (paper, Table III) and count the loads that were drawn again."""
    ranges = case.sampling
    n_gen, n_load = len(case.generators), len(case.loads)
    n_priced = len(case.priced)
    draws = generator.random(n_priced + 2 * n_gen + 6 * n_load)
    cost, rest = rounded(_between(ranges.cost, draws[:n_priced])), draws[n_priced:]
    ramps, redraws = _draw_ramps(case, rest[: 6 * n_load].reshape(n_load, 6), generator)
    instance = Instance(
        schema_="ded-bench/instance/1",
        id=f"{case.id}-{index:04d}",
        case=case.id,
        seed=(master, index),
        horizon_s=ranges.horizon_s,
        dt_s=ranges.dt_s,
        cost=_by_bus(case.priced, cost),
        load={
            bus: LoadRamp(initial=values[0], start=values[1], duration=values[2], rate=values[3])
            for bus, values in zip(case.loads, ramps.tolist(), strict=True)
        },
        initial=_initial(case, cost, ramps[:, 0], rest[6 * n_load :]),
    )
    return instance, redraws


def _initial(case: Case, cost: Array, load: Array, uniform: Array) -> Initial:
    """Power and frequencies at t = 0 (paper, eq. for P_i(0)) from the rounded values that the file holds.

    Args:
        case: gives the ranges.
        cost: of the slack, if there is one, then of the generators, (n_priced,).
        load: at t = 0, (n_load,), pu.
        uniform: (2 n_gen,).
    """
    perturbation, frequency = uniform.reshape(2, -1)
    n_gen = len(case.generators)
    p_opt = merit_order(case, cost[-n_gen:], np.inf if case.slack is None else cost[0], load)
    power = p_opt - 0.5 * (p_opt - case.p_nominal) * _between(case.sampling.perturbation, perturbation)
    # An island starts at rest.
    omega = _between(case.sampling.omega_rad_per_s, frequency) * (case.slack is not None)
    return Initial(
        power=_by_bus(case.generators, rounded(power)), omega=_by_bus(case.generators, rounded(omega))
    )


def _draw_ramps(case: Case, uniform: Array, generator: np.random.Generator) -> tuple[Array, int]:
    """Initial value, start, duration and rate of each load from uniforms, shape (n_load, 6) -> (n_load, 4).

    Loads of a case/2 that change their sign are drawn again; also returns how many were. A ramp away from
    zero keeps the sign, and is drawn at least once in four times, so that this ends.
    """
    ramps = _ramps(case, uniform, np.arange(len(uniform)))
    redraws = 0
    while case.schema_ != "ded-bench/case/1" and (changes := np.flatnonzero(_changes_sign(case, ramps))).size:
        ramps[changes] = _ramps(case, generator.random((len(changes), 6)), changes)
        redraws += len(changes)
    return ramps, redraws


def _ramps(case: Case, uniform: Array, loads: NDArray[np.int_]) -> Array:
    ranges = case.sampling
    spread = (-ranges.load_relative, ranges.load_relative)
    initial = rounded(case.load_nominal[loads] * (1 + _between(spread, uniform[:, 0])))
    start = rounded(_between(ranges.start_s, uniform[:, 1]))
    duration = rounded(_between(ranges.duration_s, uniform[:, 2]))
    sign = np.where(uniform[:, 4] < 0.5, -1.0, 1.0)
    rate = rounded(_between(case.load_rate[:, loads], uniform[:, 3]) * sign)
    rate = np.where(uniform[:, 5] < ranges.rate_zero_probability, 0.0, rate)
    return np.stack([initial, start, duration, rate], axis=1)


def _changes_sign(case: Case, ramps: Array) -> NDArray[np.bool_]:
    """Whether a load has the other sign than its nominal value at 0 or at the horizon, shape (n_load,)."""
    initial, start, duration, rate = ramps.T
    last = initial + rate * np.clip(case.sampling.horizon_s - start, 0.0, duration)
    return np.asarray(np.minimum(initial * case.load_nominal, last * case.load_nominal) < 0)


def sample_scenario(
    case: Case, seed: int, index: int, servable: Servable | None = None, duration_s: float = DURATION_S
) -> Scenario:
    """Draw scenario `index` of a seed; it is drawn again if it cannot be served.

    Scenarios of an hour or more are named `h<index>`, their loads drift.

    Args:
        servable: is asked for the loads at 0, at both ends of every ramp and at the end; on an island for
            all of it, loads linear between points ISLAND_STEP_S apart; None: all can be.

    Raises:
        InputError: the case's ranges leave hardly anything to draw, or its horizon is far too short.
    """
    if duration_s > MOST_HORIZONS * case.sampling.horizon_s:
        raise InputError(f"case {case.id}", "horizon_s", f"is too short for scenarios of {duration_s:g} s")
    numbers = (SCENARIO_SEED + seed, index) + ((round(HOUR_S),) if duration_s >= HOUR_S else ())
    generator = np.random.default_rng(np.random.SeedSequence(numbers))
    for _ in range(ATTEMPTS):
        scenario = _draw_scenario(case, numbers, generator, duration_s)
        initial = scenario.initial
        asked = _snapshots(case, scenario) if case.slack is not None else [_throughout(case, scenario)]
        for number, instance in enumerate(asked):
            served = servable(case, instance) if servable else instance
            if served is None:
                break
            initial = initial if number else served.initial
        else:
            return scenario.model_copy(update={"initial": initial})
    raise InputError(f"case {case.id}", "sampling", f"{ATTEMPTS} scenarios in a row cannot be served")


def _snapshots(case: Case, scenario: Scenario) -> list[Instance]:
    ends = {t for load in scenario.load.values() for ramp in load.ramps for t in (ramp.start, ramp.end)}
    last = scenario.duration_s + case.sampling.horizon_s
    return [scenario.snapshot(case, t) for t in sorted({0.0, *(min(t, last) for t in ends), last})]


def _throughout(case: Case, scenario: Scenario) -> Instance:
    """A scenario and the horizon beyond it as one instance."""
    last = scenario.duration_s + case.sampling.horizon_s
    times = np.append(np.arange(0.0, last - ISLAND_STEP_S / 2, ISLAND_STEP_S), last)
    load = {
        bus: LoadPoints(points=np.stack([times, one.at(times)], axis=1)) for bus, one in scenario.load.items()
    }
    changes = {"schema_": "ded-bench/instance/2", "horizon_s": last, "load": load}
    return scenario.snapshot(case, 0.0).model_copy(update=changes)


def _draw_scenario(
    case: Case, numbers: tuple[int, ...], generator: np.random.Generator, duration_s: float
) -> Scenario:
    n_gen, kind = len(case.generators), "s" if len(numbers) == 2 else "h"
    cost = rounded(_between(case.sampling.cost, generator.random(len(case.priced))))
    load = {bus: _draw_load(case, i, generator, duration_s) for i, bus in enumerate(case.loads)}
    first = np.array([load[bus].initial for bus in case.loads])
    return Scenario(
        schema_="ded-bench/scenario/1",
        id=f"{case.id}-{kind}{numbers[1]:04d}",
        case=case.id,
        seed=numbers,
        duration_s=duration_s,
        dt_s=case.sampling.dt_s,
        cost=_by_bus(case.priced, cost),
        initial=_initial(case, cost, first, generator.random(2 * n_gen)),
        load=load,
    )


def _draw_load(case: Case, number: int, generator: np.random.Generator, duration_s: float) -> ScenarioLoad:
    """One ramp in every horizon of the case; it turns round where it would leave the range."""
    ranges, nominal = case.sampling, float(case.load_nominal[number])
    widest = LOAD_RANGE if duration_s < HOUR_S else HOUR_RANGE
    spread = min(ranges.load_relative, widest)
    level = initial = float(rounded(nominal * (1 + _between((-spread, spread), generator.random(1))))[0])
    last, ended, ramps = duration_s + ranges.horizon_s, 0.0, []
    for window in np.arange(0.0, last, ranges.horizon_s):
        start, duration, size, sign, *announced = generator.random(7)
        begin = max(window + float(_between(ranges.start_s, start)), ended)
        length = float(_between(ranges.duration_s, duration))
        rate = float(_between(case.load_rate[:, number], size)) * (1 if sign < 0.5 else -1)
        if abs(level + rate * length - nominal) > widest * abs(nominal):
            rate = -rate
        room = widest * abs(nominal) + (nominal - level) * np.sign(rate)
        length = min(length, max(room, 0.0) / abs(rate)) if rate else length
        ramp = _ramp(begin, length, rate, announced)
        level, ended = level + ramp.rate * ramp.duration, ramp.end
        ramps.append(ramp)
    step_s = STEP_S if case.slack is not None else ISLAND_STEP_S
    if duration_s >= HOUR_S:
        fluctuation = _draw_drift(abs(nominal), last, generator)
    else:
        fluctuation = _draw_fluctuation(abs(nominal), last, generator, step_s)
    return ScenarioLoad(initial=initial, ramps=tuple(ramps), fluctuation=fluctuation)


def _ramp(start: float, duration: float, rate: float, announced: list[float]) -> ScenarioRamp:
    """A ramp from its values and three uniforms: whether it is announced, and how wrong."""
    start, duration, rate = rounded(np.array([start, duration, rate])).tolist()
    known = announced[0] >= UNANNOUNCED
    error_start, error_rate = START_ERROR_S * _normal(announced[1]), RATE_ERROR * _normal(announced[2])
    return ScenarioRamp(
        start=start,
        duration=duration,
        rate=rate,
        announced_start=float(rounded(np.maximum(start + error_start, 0.0))) if known else None,
        announced_rate=float(rounded(np.array(rate * (1 + error_rate)))) if known else None,
    )


def _draw_fluctuation(
    nominal: float, last: float, generator: np.random.Generator, step_s: float
) -> Fluctuation:
    """A random walk that returns within DECAY_S, smoothed over SMOOTH_S; it starts at 0.

    Both are first-order recursions, x⁺ = a x + √(1 - a²) n and y⁺ = b y + (1 - b) x; the stationary
    variance of y is (1 - b) (1 + a b) / ((1 + b) (1 - a b)).
    """
    a, b = np.exp(-step_s / DECAY_S), np.exp(-step_s / SMOOTH_S)
    n = int(np.ceil(last / step_s - 1e-9))
    noise = [_normal(uniform) for uniform in generator.random(n)]
    values, x = np.zeros(n + 1), 0.0
    for k in range(n):
        x = a * x + np.sqrt(1 - a**2) * noise[k]
        values[k + 1] = b * values[k] + (1 - b) * x
    deviation = np.sqrt((1 - b) * (1 + a * b) / ((1 + b) * (1 - a * b)))
    values = np.round(values * (FLUCTUATION * nominal / deviation), FLUCTUATION_DECIMALS) + 0.0
    return Fluctuation(step_s=step_s, values=values, decay_s=DECAY_S)


def _draw_drift(nominal: float, last: float, generator: np.random.Generator) -> Fluctuation:
    """A random walk that returns within DRIFT_DECAY_S and stays within DRIFT; it starts at 0."""
    a, n = np.exp(-DRIFT_STEP_S / DRIFT_DECAY_S), int(np.ceil(last / DRIFT_STEP_S - 1e-9))
    values = np.zeros(n + 1)
    for k, uniform in enumerate(generator.random(n)):
        step = np.sqrt(1 - a**2) * DRIFT / 2 * _normal(uniform)
        values[k + 1] = np.clip(a * values[k] + step, -DRIFT, DRIFT)
    drift = np.round(values * nominal, 6) + 0.0
    return Fluctuation(step_s=DRIFT_STEP_S, values=drift, decay_s=DRIFT_DECAY_S)


def _by_bus(buses: tuple[str, ...], values: Array) -> dict[str, float]:
    return dict(zip(buses, values.tolist(), strict=True))


def _normal(uniform: float) -> float:
    """A standard normal number from a uniform one in [0, 1)."""
    return NormalDist().inv_cdf(max(float(uniform), 2.0**-54))


def _between(ends: Range | Array, uniform: Array | float) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * uniform)


def rounded(values: Array) -> Array:
    """Values as files have them."""
    return np.round(values, DECIMALS) + 0.0  # + 0.0: no negative zero in the files
