"""How far loads that no plan knew of move frequencies, whatever the plans are.

What begins to happen after a measurement is in no plan before the next one is in force, one period and one
latency later. Until then it moves frequencies; as far as the grid is linear, by as much under every plan.
"""

from __future__ import annotations

import math

import numpy as np

from ded_bench.problem.case import Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.scenario import Scenario
from ded_bench.run.online.loop import WHOLE, LoopOptions
from ded_bench.run.online.record import Grid


def unforeseen_hz(case: Case, scenario: Scenario, options: LoopOptions, plant: Grid) -> float:
    """Largest move of any frequency by loads unknown to the plan in force.

    The grid rests at its state of t = 0, but for the difference between loads and their forecast, from each
    measurement until the next one's plan is in force. A plan can have room for it on one side only, twice the
    bound at most: what moves frequencies farther leads to an excess under every plan.

    Args:
        case: the grid.
        scenario: what happens.
        options: period, latency and forecast.
        plant: what is operated.

    Raises:
        SimulationError: the grid cannot carry such loads.
    """
    dt, loads = scenario.dt_s, scenario.p_load(case)
    lag = math.ceil(options.latency_s / dt - WHOLE)
    period = max(round(options.period_s / dt), lag, 1)
    power = np.array([scenario.initial.power[bus] for bus in case.generators])
    largest = 0.0
    for now in range(0, scenario.steps, period):
        end = min(now + period + lag, scenario.steps)
        times = np.arange(now, end + 1, dtype=np.float64) * dt
        expected = forecast(scenario, case, options.forecast, times[0], times[-1])
        unknown = loads[now : end + 1] - expected.at(times)
        if np.abs(unknown).max() == 0:
            continue
        powers = np.tile(power, (len(times), 1))
        moved = plant.advance(plant.theta, plant.omega, powers, loads[0] + unknown)
        rest = plant.advance(plant.theta, plant.omega, powers, np.tile(loads[0], (len(times), 1)))
        largest = max(largest, float(np.abs(moved.omega - rest.omega).max()))
    return largest / (2 * np.pi)
