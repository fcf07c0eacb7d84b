"""Which bounds tell dispatch on islands apart.

Peaks under static dispatch, with and without `lead`, and under practice, on validation draws, never on test
instances: quantiles of the mean frequency, swings about it and the mean at the end (mHz) and AGC travel (pu),
and the share of draws that break each regime of the case.

    python studies/island_regimes.py CASE COUNT
"""

from __future__ import annotations

import sys

import numpy as np

from ded_bench import Case
from ded_bench.methods import ed
from ded_bench.plants.plant import SimulationError, servable, simulate
from ded_bench.plants.score import ISLAND_HZ, judge
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instances

PERCENT = (0, 10, 50, 90, 100)
#: Interval of dispatch in s (None: every second and kink) and whether governors are led.
VARIANTS = {"static": (None, False), "static, lead": (None, True), "every=60": (60.0, False)}


def main(name: str, count: int) -> None:
    """Draw, simulate, print."""
    case = Case.load(name)
    instances = list(sample_instances(case, VALIDATION_SEED, count, servable=servable))
    for variant, (every, lead) in VARIANTS.items():
        runs, lost = [], 0
        for instance in instances:
            try:
                runs.append((instance, simulate(case, instance, ed.dispatch(case, instance, every, lead))))
            except SimulationError:
                lost += 1
        scores = {regime: [judge(case, i, run, regime) for i, run in runs] for regime in case.regimes}
        first = next(iter(scores.values()))
        weight = case.inertia / case.inertia.sum()
        end = [1e3 * abs(run.omega[-1] @ weight) / (2 * np.pi) for _, run in runs]
        print(f"{case.id}, {variant}: {len(runs)} instances, {lost} collapse")
        for quantity, values in (
            ("mean, mHz", [1e3 * (s.mean_freq_max_hz or 0.0) for s in first]),
            ("swings, mHz", [1e3 * (s.swing_max_hz or 0.0) for s in first]),
            ("end, mHz", end),
            ("AGC, pu", [s.agc_travel_pu for s in first]),
        ):
            shown = "  ".join(f"{value:8.2f}" for value in np.percentile(values, PERCENT))
            print(f"  {quantity:<12} {shown}")
        for regime, found in scores.items():
            print(
                f"  breaks {regime}: {100 * np.mean([s.freq_violation_hz > ISLAND_HZ for s in found]):.0f} %"
            )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
