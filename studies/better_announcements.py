"""What would it be worth to know ramps better? `ded-rti` on 9bus with other announcements.

    python studies/better_announcements.py --notice 0,1.5,3
    ded-bench scenarios --seed 4242 --out drawn
    python studies/better_announcements.py --wait 0,0.5,1,2 --scenario drawn/*.json

With a notice, start and rate of every ramp are known as they are some seconds before it begins, announced
or not. With a wait, no plan expects a ramp that has not begun sooner than some seconds from now, so that one
that is late is not expected at once. Costs are over the same controller with a perfect forecast and no
latency. One scenario takes some ten seconds, and as much with every notice or wait.
"""

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ded_bench import Case, Settings
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.problem.forecast import Forecast, forecast
from ded_bench.problem.scenario import Scenario, ScenarioRamp, load_scenarios
from ded_bench.results.folder import search_folders
from ded_bench.run.online import loop
from ded_bench.run.online.judgement import Judgement, judge_operation
from ded_bench.run.online.loop import Planner

REGIME, METHOD, LATENCY_S = "TO", "ded-rti", 0.03


class Announcements:
    """Forecasts a scenario as `forecast` does, with announcements that depend on the time of the forecast."""

    def __init__(self, notice_s: float, wait_s: float) -> None:
        self.notice_s, self.wait_s = notice_s, wait_s

    def __call__(self, scenario: Scenario, case: Case, quality: str, now: float, until: float) -> Forecast:
        """See `ded_bench.problem.forecast.forecast`."""
        loads = {
            bus: load.model_copy(update={"ramps": tuple(self._told(ramp, now) for ramp in load.ramps)})
            for bus, load in scenario.load.items()
        }
        return forecast(scenario.model_copy(update={"load": loads}), case, quality, now, until)

    def _told(self, ramp: ScenarioRamp, now: float) -> ScenarioRamp:
        if ramp.start <= now + self.notice_s:
            told = {"announced_start": ramp.start, "announced_rate": ramp.rate}
        elif ramp.announced_start is not None:
            told = {"announced_start": max(ramp.announced_start, now + self.wait_s)}
        else:
            return ramp
        return ramp.model_copy(update=told)


def operate(case: Case, scenario: Scenario, options: loop.LoopOptions) -> Judgement:
    """Judge what the controller makes of a scenario."""
    settings = Settings(search=search_folders(case))
    outcome = loop.run_loop(case, scenario, Planner(case, REGIME, METHOD, settings), options)
    return judge_operation(case, scenario, outcome.trajectory, REGIME)


def seconds(text: str) -> list[float]:
    """Numbers between commas."""
    return [float(word) for word in text.split(",")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per scenario, notice and wait, and the means over scenarios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--notice", type=seconds, default=[0.0], metavar="S[,S]", help="before a ramp")
    parser.add_argument("--wait", type=seconds, default=[0.0], metavar="S[,S]", help="for what has not begun")
    parser.add_argument("--scenario", type=Path, nargs="+", metavar="FILE", help="instead of the case's")
    parser.add_argument("--out", type=Path, default=Path("announcements.csv"), help="(default: %(default)s)")
    asked = parser.parse_args(arguments)
    case = Case.load("9bus")
    files = asked.scenario or sorted((SHIPPED_CASES / case.id / "scenarios").glob(f"{case.id}-s*.json"))
    rows = []
    for scenario in load_scenarios(files, case):
        loop.forecast = forecast
        known = operate(case, scenario, loop.LoopOptions(forecast="perfect"))
        for notice, wait in itertools.product(asked.notice, asked.wait):
            loop.forecast = Announcements(notice, wait)
            told = operate(case, scenario, loop.LoopOptions(latency_s=LATENCY_S))
            rows.append(
                {
                    "scenario": scenario.id,
                    "notice_s": notice,
                    "wait_s": wait,
                    "over_known_percent": 100.0 * (told.objective / known.objective - 1.0),
                    "max_excess_mhz": 1e3 * told.max_excess_hz,
                }
            )
            print(*rows[-1].values(), flush=True)
    loop.forecast = forecast
    table = pd.DataFrame(rows)
    table.to_csv(asked.out, index=False)
    print(table.drop(columns="scenario").groupby(["notice_s", "wait_s"]).mean().to_string())


if __name__ == "__main__":
    main()
