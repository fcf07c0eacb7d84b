"""Forecast: what is known at an instant of a scenario's loads from then on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Initial, Instance, LoadPoints, ramped_for
from ded_bench.problem.scenario import Scenario, ScenarioLoad

#: `announced`: ramps as announced; `perfect`: what will be; `worse`: announcements four times as wrong;
#: `persistence`: loads stay as they are.
QUALITIES = ("announced", "perfect", "worse", "persistence")
WORSE = 4.0
#: Points closer together than this are one, s.
RESOLUTION = 1e-9


@dataclass(frozen=True, eq=False)
class Forecast:
    """Loads from an instant on, linear between points."""

    loads: tuple[tuple[Array, Array], ...]  # of each load: times in s of the scenario, injections in pu

    def at(self, t: Array) -> Array:
        """Forecast injections at times `t` in s of the scenario, shape (n_t, n_load), pu."""
        return np.stack([np.interp(t, times, values) for times, values in self.loads], axis=-1)

    def instance(
        self, scenario: Scenario, case: Case, start: float, horizon_s: float, initial: Initial, name: str
    ) -> Instance:
        """An instance of this name that begins at `start`, s of the scenario, in a state (instance/2)."""
        points = (_points(times, values, start, horizon_s) for times, values in self.loads)
        return Instance(
            schema_="ded-bench/instance/2",
            id=name,
            case=case.id,
            seed=scenario.seed,
            horizon_s=horizon_s,
            dt_s=scenario.dt_s,
            cost=scenario.cost,
            load=dict(zip(case.loads, points, strict=True)),
            initial=initial,
        )


def forecast(scenario: Scenario, case: Case, quality: str, now: float, until: float) -> Forecast:
    """Forecast the loads from `now` until `until`, s.

    Ramps that have begun go on as they are; others come as announced, but not before `now`, and not at all
    where they are not announced; the fluctuation decays by exp(-(t - now) / decay), linear between points
    `step_s` apart.

    Args:
        scenario: what will be, and what is announced of it.
        case: gives the order of the loads.
        quality: one of QUALITIES.
        now: when the forecast is made.
        until: the end of what is asked for; after `now`.
    """
    return Forecast(tuple(_load(scenario.load[bus], quality, now, until) for bus in case.loads))


def _load(load: ScenarioLoad, quality: str, now: float, until: float) -> tuple[Array, Array]:
    if quality == "persistence":
        return np.array([now, until]), np.full(2, load.at(np.array(now)))
    if quality == "perfect":
        inside = load.fluctuation.times
        inside = inside[(inside > now) & (inside < until)].tolist()
        times = _joined([*inside, *(t for ramp in load.ramps for t in (ramp.start, ramp.end))], now, until)
        return times, load.at(times)
    ramps = tuple(_expected(load, WORSE if quality == "worse" else 1.0, now))
    steps = np.arange(now, until, load.fluctuation.step_s).tolist()
    times = _joined(
        [*steps, *(t for start, duration, _ in ramps for t in (start, start + duration))], now, until
    )
    decay = np.exp(-(times - now) / load.fluctuation.decay_s)
    ramped = sum(rate * ramped_for(times, start, duration) for start, duration, rate in ramps)
    return times, np.asarray(load.initial + ramped + load.fluctuation_at(np.array(now)) * decay)


def _expected(load: ScenarioLoad, wrong: float, now: float) -> Iterator[tuple[float, float, float]]:
    """Start, duration and rate of ramps that are known at `now`; announcements are `wrong` times as wrong."""
    for ramp in load.ramps:
        if ramp.start <= now:
            yield ramp.start, ramp.duration, ramp.rate
        elif ramp.announced_start is not None and ramp.announced_rate is not None:
            start = max(ramp.start + wrong * (ramp.announced_start - ramp.start), now)
            yield start, ramp.duration, ramp.rate + wrong * (ramp.announced_rate - ramp.rate)


def _joined(times: Iterable[float], first: float, last: float) -> Array:
    """The times strictly between two, each once, and these two."""
    kept = [first]
    for t in sorted(times):
        if kept[-1] + RESOLUTION < t < last - RESOLUTION:
            kept.append(t)
    return np.array([*kept, last])


def _points(times: Array, values: Array, start: float, horizon_s: float) -> LoadPoints:
    chosen = _joined(times.tolist(), start, start + horizon_s)
    relative = chosen - start
    relative[-1] = horizon_s
    pairs = zip(relative.tolist(), np.interp(chosen, times, values).tolist(), strict=True)
    return LoadPoints(points=tuple(pairs))
