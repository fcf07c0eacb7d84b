"""Operate drawn scenarios with a method, `ded-rti` perhaps with other constants: what it costs and keeps.

    python studies/drawn_operation.py two-area --count 50 --latency 0.05 --set ALWAYS=0.1 SWING_S=2
    python studies/drawn_operation.py 39bus --method ded-admm --options iterations=80,margin=0.1

Prints cost over hindsight, the largest excess over the bound, and the processor time of plans, of each
scenario and of all. Names are those of constants in `methods/surprises.py` and `methods/ded_rti.py`. Policies
are those of the case's reference run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ded_bench import Case, Schedule, Settings, Solution, Status
from ded_bench.methods import ded_rti, surprises
from ded_bench.methods.registry import get_method
from ded_bench.plants.plant import servable
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.scenario import Scenario
from ded_bench.run.online.judgement import hindsight, judge_operation
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop

SEED, DURATION_S, REGIME = 4_200_001, 60.0, "TO"


class Operated(NamedTuple):
    """What came of a scenario."""

    objective: float
    excess_hz: float  # largest over the bound, negative within it
    plans_s: float  # processor time of all plans


def operated(
    case: Case,
    scenario: Scenario,
    options: LoopOptions,
    constants: Mapping[str, float],
    method: str = "ded-rti",
    settings: str = "",
) -> Operated:
    """Operate a scenario with some constants changed, for all that follows in this process, too."""
    for name, value in constants.items():
        setattr(surprises if hasattr(surprises, name) else ded_rti, name, value)
    results = Path("results") / f"{case.id}-reference"
    solver, spent = get_method(method).prepare(case, REGIME, Settings(settings, search=(results,))), 0.0

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        nonlocal spent
        began = time.process_time()
        if hasattr(solver, "solve"):
            plan = solver.solve(instance, None if last is None else Solution(Status.FEASIBLE, last))
        else:
            plan = solver(instance)
        spent += time.process_time() - began
        return Planned(plan.schedule)

    trajectory = run_loop(case, scenario, ask, options).trajectory
    bounds = case.bounds(REGIME)
    beyond = bounds.beyond(trajectory.omega @ bounds.matrix.T)[1:]  # where it begins is given
    excess = float(beyond.max()) / (2 * np.pi)
    return Operated(judge_operation(case, scenario, trajectory, REGIME).objective, excess, spent)


def _one(
    case: Case, index: int, duration_s: float, options: LoopOptions, constants: dict[str, float], *method: str
) -> tuple[int, float, Operated]:
    scenario = sample_scenario(case, SEED, index, servable, duration_s)
    found = operated(case, scenario, options, constants, *method)
    _, best, _ = hindsight(case, scenario, REGIME)
    return index, 100 * (found.objective / best.objective - 1), found


def arguments(text: str | None) -> argparse.ArgumentParser:
    """What scripts that operate drawn scenarios of a case take."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("case")
    parser.add_argument("--period", type=float, default=0.1)
    parser.add_argument("--latency", type=float, default=0.05)
    parser.add_argument("--workers", type=int, default=1)
    return parser


def main() -> None:
    """Operate them all."""
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--duration", type=float, default=DURATION_S)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--method", default="ded-rti")
    parser.add_argument("--options", default="")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    a = parser.parse_args()
    case, options = Case.load(a.case), LoopOptions(period_s=a.period, latency_s=a.latency)
    constants = {name: float(value) for name, value in (text.split("=") for text in a.set)}
    rows = []
    with ProcessPoolExecutor(a.workers, initializer=threadpool_limits, initargs=(1,)) as pool:
        given = a.duration, options, constants, a.method, a.options
        calls = [pool.submit(_one, case, a.first + index, *given) for index in range(a.count)]
        for call in calls:
            index, increase, found = call.result()
            rows.append((increase, max(1e3 * found.excess_hz, 0.0), found.plans_s))
            print("{}: {:.3f} %, {:.3f} mHz, {:.1f} s".format(index, *rows[-1]), flush=True)
    increase, excess, seconds = np.array(rows).T
    print(
        f"{a.case} {a.method} {a.options} {constants or ''}: {increase.mean():.3f} %, "
        f"excess {excess.mean():.4f} mHz in the mean, "
        f"{excess.max():.3f} at most, none in {int((excess == 0).sum())} of {a.count}; {seconds.mean():.1f} s"
    )


if __name__ == "__main__":
    main()
