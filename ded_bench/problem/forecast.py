"""Forecast: what is known at an instant of a scenario's loads from then on."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.compiled import compiled, interpolated
from ded_bench.problem.instance import Initial, Instance, LoadPoints
from ded_bench.problem.scenario import Scenario

#: How many times as wrong announcements of the quality `worse` are.
WORSE = 4.0
#: Points closer together than this are one, s.
RESOLUTION = 1e-9


@dataclass(frozen=True, eq=False)
class Forecast:
    """Loads from an instant on, linear between points; one at the time of the one before says nothing."""

    scenario: Scenario
    case: Case
    times: Array  # (n_load, n_points), s of the scenario, ascending; loads in the scenario's order
    values: Array  # (n_load, n_points), injections, pu

    def at(self, t: Array) -> Array:
        """Forecast injections at times `t` in s of the scenario, shape (n_t, n_load), pu."""
        points = dict(zip(self.scenario.load, zip(self.times, self.values, strict=True), strict=True))
        return np.stack([np.interp(t, *points[bus]) for bus in self.case.loads], axis=-1)

    def instance(self, start: float, horizon_s: float, initial: Initial, name: str) -> Instance:
        """An instance of this name that begins at `start`, s of the scenario, in a state (instance/2)."""
        points, ends = _distinct(self.times, self.values, start, horizon_s)
        points.flags.writeable = False
        # Of parts that were checked: to do it again would take as long as the plant.
        loads = [LoadPoints.model_construct(points=points[i:j]) for i, j in itertools.pairwise(ends.tolist())]
        return Instance.model_construct(
            schema_="ded-bench/instance/2",
            id=name,
            case=self.case.id,
            seed=(),  # from which the loads could be drawn again
            horizon_s=horizon_s,
            dt_s=self.scenario.dt_s,
            cost=self.scenario.cost,
            load=dict(zip(self.scenario.load, loads, strict=True)),
            initial=initial,
        )


def forecast(scenario: Scenario, case: Case, quality: str, now: float, until: float) -> Forecast:
    """Forecast the loads from `now` until `until`, s.

    Ramps that have begun go on as they are; others come as announced, but not before `now`, and not at all
    where they are not announced; the fluctuation decays by exp(-(t - now) / decay), linear between points
    `step_s` apart.

    Args:
        scenario: what will be, and what is announced of it.
        case: the scenario's.
        quality: one of QUALITIES.
        now: when the forecast is made.
        until: the end of what is asked for; after `now`.
    """
    if quality in ("announced", "worse"):
        wrong = WORSE if quality == "worse" else 1.0
        return Forecast(scenario, case, *_announced(now, until, wrong, scenario.ramps, scenario.fluctuations))
    start, duration, *_ = scenario.ramps
    _, step, _, fluctuations = scenario.fluctuations
    ends = np.full((len(start), 2), [now, until])
    kinks = step * np.arange(fluctuations.shape[1]), start, start + duration
    times = np.concatenate([ends, *(kinks if quality == "perfect" else ())], axis=1).clip(now, until)
    times.sort(axis=1)
    known = times if quality == "perfect" else np.full_like(times, now)
    values = np.array([load.at(t) for load, t in zip(scenario.load.values(), known, strict=True)])
    return Forecast(scenario, case, times, values)


@compiled
def _announced(
    now: float, until: float, wrong: float, ramps: Array, others: tuple[Array, ...]
) -> tuple[Array, Array]:
    """Times and values of a forecast whose announcements are so many times as wrong as those given."""
    initial, step, decay, fluctuations = others
    n_ramps, n_steps = ramps.shape[2], math.ceil((until - now) / step.min()) + 1
    times = np.empty((len(step), n_steps + 2 * n_ramps))
    values = np.empty(times.shape)
    for load, own in enumerate(times):
        own_step, known = step[load, 0], ramps[:, load].copy()
        start, duration, rate = known[0], known[1], known[2]
        for k in range(n_steps):
            own[k] = min(now + own_step * k, until)
        for r in range(n_ramps):
            if start[r] > now:  # it comes as announced, if it is
                start[r] = max(start[r] + wrong * (known[3, r] - start[r]), now)
                rate[r] += wrong * (known[4, r] - rate[r])
            own[n_steps + 2 * r] = min(max(start[r], now), until)
            own[n_steps + 2 * r + 1] = min(max(start[r] + duration[r], now), until)
        own.sort()
        k = min(int(now // own_step), fluctuations.shape[1] - 2)
        before, after = fluctuations[load, k], fluctuations[load, k + 1]
        present = (after - before) / ((k + 1) * own_step - k * own_step) * (now - k * own_step) + before
        for j in range(len(own)):
            ramped = 0.0
            for r in range(n_ramps):
                ramped += min(max(own[j] - start[r], 0.0), duration[r]) * rate[r]
            values[load, j] = initial[load, 0] + ramped + present * math.exp((now - own[j]) / decay[load, 0])
    return times, values


@compiled
def _distinct(times: Array, values: Array, start: float, horizon_s: float) -> tuple[Array, Indices]:
    """Distinct points of all loads from `start` on, (n, 2), and where each load's begin and end."""
    found, ends = np.empty((times.size + 2 * len(times), 2)), np.zeros(len(times) + 1, np.int64)
    count, limits = 0, np.array([start, start + horizon_s])
    for load, own in enumerate(times):
        first, last = interpolated(own, values[load].copy().reshape((-1, 1)), limits)
        found[count, 0], found[count, 1] = 0.0, first[0]
        for t, value in zip(own, values[load]):  # noqa: B905  (Numba's has no `strict`)
            if t - start > found[count, 0] + RESOLUTION and t < limits[1] - RESOLUTION:
                count += 1
                found[count, 0], found[count, 1] = t - start, value
        found[count + 1, 0], found[count + 1, 1] = horizon_s, last[0]
        count += 2
        ends[load + 1] = count
    return found[:count], ends
