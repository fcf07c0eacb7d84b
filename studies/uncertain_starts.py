"""What wrong starts of announced ramps do to an island, and what a forecast of their mean does against it.

Plans of `ded-admm` every second on drawn scenarios. `begins`: a ramp begins when it is announced, or at once
where it is late. `mean`: its start is uncertain by some seconds; the forecast has five ramps of a fifth of
its rate, which begin at the 10, 30, 50, 70 and 90 % quantiles of its start, given that it has not begun.
`known`: its start is known.

    python studies/uncertain_starts.py CASE COUNT
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri

from ded_bench import Case, Schedule, Settings, Solution, Status
from ded_bench.methods.registry import get_method
from ded_bench.plants.plant import servable
from ded_bench.problem.forecast import Forecast, forecast
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.scenario import Scenario, ScenarioRamp
from ded_bench.run.online import loop
from ded_bench.run.online.judgement import judge_operation

ROOT = Path(__file__).resolve().parents[1]
SEED, REGIME, METHOD, DURATION_S = 4_710_000, "TO", "ded-admm", 120.0
QUANTILES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
#: Later than so many standard deviations a ramp is expected at once.
LATEST = 6.0


def known(ramp: ScenarioRamp, now: float) -> list[ScenarioRamp]:
    """The ramp with its true start."""
    return [ramp.model_copy(update={"announced_start": ramp.start})]


def mean(ramp: ScenarioRamp, now: float, deviation_s: float) -> list[ScenarioRamp]:
    """Five ramps in its place."""
    begin, late = ramp.announced_start, (now - ramp.announced_start) / deviation_s
    if late < LATEST:
        starts = begin + deviation_s * ndtri(ndtr(late) + (1.0 - ndtr(late)) * QUANTILES)
    else:
        starts = np.full(len(QUANTILES), now)
    rates = {"rate": ramp.rate / len(QUANTILES), "announced_rate": ramp.announced_rate / len(QUANTILES)}
    return [ramp.model_copy(update={"announced_start": max(s, now)} | rates) for s in starts.tolist()]


def told(
    replaced: Callable[[ScenarioRamp, float], list[ScenarioRamp]], *asked: Scenario | Case | str | float
) -> Forecast:
    """See `ded_bench.problem.forecast.forecast`; ramps that have not begun are replaced."""
    scenario, case, quality, now, until = asked
    loads = {}
    for bus, load in scenario.load.items():
        ramps: list[ScenarioRamp] = []
        for ramp in load.ramps:
            uncertain = ramp.announced_start is not None and ramp.start > now
            ramps += replaced(ramp, now) if uncertain else [ramp]
        loads[bus] = load.model_copy(update={"ramps": tuple(ramps)})
    return forecast(scenario.model_copy(update={"load": loads}), case, quality, now, until)


FORECASTS: dict[str, Callable[..., Forecast]] = {
    "begins": forecast,
    "mean, 1.5 s": functools.partial(told, functools.partial(mean, deviation_s=1.5)),
    "mean, 0.7 s": functools.partial(told, functools.partial(mean, deviation_s=0.7)),
    "known": functools.partial(told, known),
}


def operate(case: Case, scenario: Scenario) -> dict[str, float]:
    """Numbers of one scenario under the forecast in force."""
    settings = Settings(search=(ROOT / "results" / f"{case.id}-reference",))
    solver = get_method(METHOD).prepare(case, REGIME, settings)

    def ask(instance: Instance, last: Schedule | None) -> loop.Planned:
        begun = None if last is None else Solution(Status.FEASIBLE, last)
        return loop.Planned(solver.solve(instance, last=begun).schedule)

    outcome = loop.run_loop(case, scenario, ask, loop.LoopOptions())
    found = judge_operation(case, scenario, outcome.trajectory, REGIME)
    return {
        "peak_mhz": 1e3 * found.mean_freq_max_hz,
        "rms_mhz": 1e3 * found.mean_freq_rms_hz,
        "agc_travel_pu": found.agc_travel_pu,
        "objective": found.objective,
    }


def main(name: str, count: str) -> None:
    """Print means, and differences to `begins` in pairs with 95 % confidence intervals."""
    case = Case.load(name)
    scenarios = [sample_scenario(case, SEED, k, servable, DURATION_S) for k in range(int(count))]
    found = {}
    for label, one in FORECASTS.items():
        loop.forecast = one
        found[label] = pd.DataFrame([operate(case, scenario) for scenario in scenarios])
        change = 100.0 * (found[label] / found["begins"] - 1.0)
        half = 1.96 * change.std() / np.sqrt(len(change))
        print(name, label, found[label].mean().round(3).to_dict())
        print("  change, %:", {c: f"{change[c].mean():.3g} ± {half[c]:.2g}" for c in change}, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:3])
