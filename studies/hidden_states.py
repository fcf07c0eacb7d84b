"""What knowing the states that nobody measures is worth to plans in operation.

Scenarios are drawn, none of them committed. `ded-rti` and the case's policy plan every second, blind or with
an estimate of fluxes, exciters and valves (`methods/state_estimate.py`); static dispatch stands beside them.

    python studies/hidden_states.py CASE REGIME COUNT DURATION_S
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ded_bench import Case, Schedule, Settings, Solution, Status
from ded_bench.methods.registry import get_method
from ded_bench.plants.plant import servable
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_scenario
from ded_bench.run.online.judgement import judge_operation
from ded_bench.run.online.loop import Ask, LoopOptions, Planned, run_loop

SEED = 2_500_000
COLUMNS = "| forecast | plans | mean, mHz | swings, mHz | AGC travel, pu | cost over `ed`, % | s a plan |"


def asked(case: Case, regime: str, method: str, options: str, remembers: bool, seconds: list[float]) -> Ask:
    """Plans of one method; without memory it is prepared anew for each."""

    def prepared() -> Callable[..., Solution]:
        results = Path("results") / f"{case.id}-reference"
        solver = get_method(method).prepare(case, regime, Settings(options, search=(results,)))
        return getattr(solver, "solve", solver)

    solve = prepared()

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        nonlocal solve
        if not remembers:
            solve = prepared()
        started = time.perf_counter()
        given = {} if method == "ed" or last is None else {"last": Solution(Status.FEASIBLE, last)}
        schedule = solve(instance, **given).schedule
        seconds.append(time.perf_counter() - started)
        return Planned(schedule)

    return ask


def main(name: str, regime: str, count: str, duration_s: str) -> None:
    """Print the table: medians over the scenarios."""
    case = Case.load(name)
    scenarios = [sample_scenario(case, SEED, i, servable, float(duration_s)) for i in range(int(count))]
    ways = [
        ("`ed`", "ed", "", True),
        ("`ded-rti`, blind", "ded-rti", "", False),
        ("`ded-rti`", "ded-rti", "", True),
        ("`ded-admm`, blind", "ded-admm", "", False),
        ("`ded-admm`", "ded-admm", "", True),
    ]
    print(COLUMNS + "\n| --- | --- |" + " ---: |" * 5)
    for forecast in ("perfect", "announced"):
        cheapest: list[float] = []
        for label, method, options, remembers in ways:
            found, seconds = [], []
            for scenario in scenarios:
                ask = asked(case, regime, method, options, remembers, seconds)
                trajectory = run_loop(case, scenario, ask, LoopOptions(forecast=forecast)).trajectory
                found.append(judge_operation(case, scenario, trajectory, regime))
            costs = [one.objective for one in found]
            cheapest = cheapest or costs
            over = 100 * (np.array(costs) / cheapest - 1)
            peak, swing, agc = (
                np.median([getattr(one, column) for one in found])
                for column in ("mean_freq_max_hz", "swing_max_hz", "agc_travel_pu")
            )
            numbers = f"{1e3 * peak:.1f} | {1e3 * swing:.2f} | {agc:.2f} | {np.median(over):+.2f}"
            print(f"| {forecast} | {label} | {numbers} | {np.median(seconds):.2f} |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main(*sys.argv[1:])
