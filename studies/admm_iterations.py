"""What more iterations of `ded-admm` bring: `python studies/admm_iterations.py two-area 32`.

Answers to validation instances with several values of the option `iterations` are simulated; gaps are over
`ded-slp`. Some minutes on one core.
"""

import sys

import numpy as np
import pandas as pd

from ded_bench import Case, Settings, score, solve
from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import validation_instances

REGIME, FIRST = "TO", 20_000
OPTIONS = ("default", "iterations=10", "iterations=20", "iterations=40", "iterations=80", "iterations=160")


def main(name: str, count: int) -> None:
    """Print a row for each number of iterations."""
    case, rows = Case.load(name), []
    for instance in validation_instances(case, count, FIRST, servable=servable):
        best = score(instance, solve(instance, "ded-slp", REGIME).schedule, REGIME).objective
        for options in OPTIONS:
            answer = solve(instance, "ded-admm", REGIME, settings=Settings(options))
            verdict = score(instance, answer.schedule, REGIME)
            gap = 100 * (verdict.objective / best - 1)
            rows.append((options, gap, verdict.freq_violation_hz, verdict.feasible))
    table = pd.DataFrame(rows, columns=["settings", "gap_percent", "violation_hz", "feasible"])
    grouped = table.groupby("settings", sort=False)
    print(
        grouped.agg(
            gap_percent=("gap_percent", "mean"),
            p95_percent=("gap_percent", lambda gaps: np.quantile(gaps, 0.95)),
            violation_hz=("violation_hz", "mean"),
            largest_hz=("violation_hz", "max"),
            feasible=("feasible", "sum"),
        ).to_string(float_format="{:.3g}".format)
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
