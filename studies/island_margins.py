"""Margins of the islands' policies on fresh validation draws: `python studies/island_margins.py CASE COUNT`.

Each line has other parts of the bound on swings that iterations leave free, and other distances from a bound
within which a schedule is mended; the committed weights answer.
"""

import sys

import numpy as np

from ded_bench import Case, Schedule
from ded_bench.methods.island import island_iterations, island_policy
from ded_bench.methods.island.island_policy import IslandPolicy
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import servable
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import validation_instances
from ded_bench.results.folder import search_folders

#: No choice was made on these draws before.
FIRST = 70_000
#: Of swings, and within which part of a bound is mended; the committed ones first.
MARGINS = ((0.10, 0.05), (0.10, 0.04), (0.08, 0.05), (0.11, 0.05), (0.12, 0.06))


def main(name: str, count: int) -> None:
    """Print feasible answers, and the mean cost against the first line's."""
    case = Case.load(name)
    draws = list(validation_instances(case, count, FIRST, servable=servable))
    known: dict[str, np.ndarray] = {}
    for swing, near in MARGINS:
        island_iterations.SWING_MARGIN, island_policy.NEAR = swing, near
        for regime in case.regimes:
            policy = IslandPolicy.find(case, regime, Settings(search=search_folders(case)))
            answers = [Schedule(policy.knots, policy.powers(draw)) for draw in draws]
            scores = [score(case, *pair, regime) for pair in zip(draws, answers, strict=True)]
            costs = np.array([one.objective for one in scores])
            more = 100 * (costs / known.setdefault(regime, costs) - 1).mean()
            kept = sum(one.feasible for one in scores)
            worst = 1e3 * max(one.freq_violation_hz for one in scores)
            print(f"| {name} | {regime} | {swing} | {near} | {kept} of {count} | {more:+.4f} | {worst:.2f} |")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
