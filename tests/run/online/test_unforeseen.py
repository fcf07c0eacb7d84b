"""Loads that no plan knew of move frequencies by so much, whatever the plans are."""

from __future__ import annotations

import numpy as np
import pytest
from ded_bench.plants.lossless.servable import servable

from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Fluctuation, Scenario, ScenarioRamp
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.schedule import Schedule
from ded_bench.run.online.loop import LoopOptions, run_loop
from ded_bench.run.online.planner import Plan
from ded_bench.run.online.record import Plant
from ded_bench.run.online.unforeseen import unforeseen_hz


def surprising(case: Case, rate: float) -> Scenario:
    """Nothing happens but one ramp that nobody announced."""
    scenario = sample_scenario(case, 0, 3, servable, 20.0)
    load = {}
    for number, (bus, one) in enumerate(scenario.load.items()):
        ramp = ScenarioRamp(start=4.45, duration=10.0, rate=rate, announced_start=None, announced_rate=None)
        still = Fluctuation(step_s=1.0, values=(0.0, 0.0), decay_s=20.0)
        load[bus] = one.model_copy(update={"ramps": (ramp,) if number == 0 else (), "fluctuation": still})
    return scenario.model_copy(update={"load": load})


def stay(instance, last):
    """Powers stay as they are."""
    power = np.array(list(instance.initial.power.values()))
    return Plan(Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power])))


@pytest.mark.parametrize("options", [LoopOptions(), LoopOptions(period_s=0.7, latency_s=1.2)])
def test_it_is_what_happens_when_powers_stay(case: Case, options: LoopOptions) -> None:
    """From the one ramp to the plan that knows of it: the difference it makes."""
    scenario = surprising(case, -1e-2)
    found = unforeseen_hz(case, scenario, options, Plant(case, scenario))
    with_ramp, without = (
        run_loop(case, one, stay, options).trajectory.omega for one in (scenario, surprising(case, 0.0))
    )
    moved = np.abs(with_ramp - without) / (2 * np.pi)
    decisions = np.arange(0.0, 20.0, max(options.period_s, options.latency_s))
    known = decisions[decisions > 4.45][0] + options.latency_s
    reached = moved[: round(known / scenario.dt_s) + 1].max()
    # The grid is nearly linear: it matters little that one swings a little at t = 0 and the other rests.
    assert found == pytest.approx(reached, rel=1e-2)
    assert found > 0


def test_what_is_foreseen_moves_nothing_and_what_comes_late_moves_more(case: Case) -> None:
    scenario = surprising(case, -1e-3)
    plant = Plant(case, scenario)
    foreseen = unforeseen_hz(case, scenario, LoopOptions(forecast="perfect"), plant)
    assert foreseen == pytest.approx(0.0, abs=1e-12)
    moved = [unforeseen_hz(case, scenario, LoopOptions(period_s=s), plant) for s in (0.1, 1.0, 2.0)]
    assert 0 < moved[0] < moved[1] < moved[2]
    twice = unforeseen_hz(case, surprising(case, -2e-3), LoopOptions(period_s=1.0), plant)
    assert twice == pytest.approx(2 * moved[1], rel=1e-3)  # nearly linear
