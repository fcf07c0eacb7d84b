"""How surely operation keeps the bound, and what a conformal margin promises of it.

Scenarios of 60 s are drawn, none of them committed: some to calibrate, others to check. Of each the largest
excess over the bound is kept, negative within it. With n scenarios to calibrate, that of a fresh one is at
most the k-th smallest of theirs, k = ⌈(n + 1) (1 - α)⌉, with probability 1 - α or more (split conformal
prediction: all are drawn alike and independently). So a bound tighter by that value would be kept so surely.

    python studies/operation_certificate.py two-area rows.csv --calibrate 50 --check 200

Rows are kept as they come; what is there is not made again.
"""

from __future__ import annotations

import csv
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from drawn_operation import DURATION_S, arguments, operated
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from ded_bench import Case
from ded_bench.plants.plant import servable
from ded_bench.problem.sampling import sample_scenario
from ded_bench.run.online.loop import LoopOptions

#: Seeds of scenarios to calibrate with, and to check.
CALIBRATE, CHECK = 4_200_003, 4_200_004
ALPHA, DELTA, STRICT_HZ = 0.05, 0.01, 1e-6


def excess_hz(case: Case, seed: int, index: int, options: LoopOptions) -> float:
    """Largest excess of one scenario over the bound, negative within it, Hz."""
    scenario = sample_scenario(case, seed, index, servable, DURATION_S)
    return operated(case, scenario, options, {}).excess_hz


def main() -> None:
    """Operate what is missing, and print what is promised and what came."""
    parser = arguments(__doc__)
    parser.add_argument("rows", type=Path)
    parser.add_argument("--calibrate", type=int, default=50)
    parser.add_argument("--check", type=int, default=200)
    a = parser.parse_args()
    case, options = Case.load(a.case), LoopOptions(period_s=a.period, latency_s=a.latency)
    found: dict[tuple[int, int], float] = {}
    if a.rows.exists():
        with a.rows.open() as file:
            found = {(int(s), int(i)): float(hz) for s, i, hz in list(csv.reader(file))[1:]}
    else:
        a.rows.write_text("seed,index,excess_hz\n")
    wanted = [(CALIBRATE, i) for i in range(a.calibrate)] + [(CHECK, i) for i in range(a.check)]
    with ProcessPoolExecutor(a.workers, initializer=threadpool_limits, initargs=(1,)) as pool:
        calls = {pool.submit(excess_hz, case, *one, options): one for one in wanted if one not in found}
        for call in as_completed(calls):
            found[calls[call]] = call.result()
            with a.rows.open("a") as file:
                file.write("{},{},{!r}\n".format(*calls[call], call.result()))
    values = {
        s: np.array([hz for (seed, _), hz in sorted(found.items()) if seed == s]) for s in (CALIBRATE, CHECK)
    }
    n = len(values[CALIBRATE])
    k = math.ceil((n + 1) * (1 - ALPHA))
    promised = np.sort(values[CALIBRATE])[k - 1] if k <= n else np.inf
    print(f"{n} to calibrate: with {1 - ALPHA:.0%} the largest excess is at most {1e3 * promised:.3f} mHz")
    for name, limit in (("so much", promised), ("the bound", STRICT_HZ)):
        kept, m = int((values[CHECK] <= limit).sum()), len(values[CHECK])
        interval = binomtest(kept, m).proportion_ci(1 - 2 * DELTA, "exact")
        print(f"{kept} of {m} keep {name}: with {1 - DELTA:.0%} confidence {interval.low:.1%} or more")
    beyond = np.maximum(values[CHECK], 0.0) * 1e3
    print(f"largest excess: mean {beyond.mean():.4f} mHz, largest {beyond.max():.3f} mHz")


if __name__ == "__main__":
    main()
