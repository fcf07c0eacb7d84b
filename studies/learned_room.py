"""Learn the margins and the room of `ded-rti` through the closed loop, by CMA-ES with common random numbers.

Every generation draws scenarios of 60 s, the same for all its candidates; each candidate operates them, and
counts by what it costs over the generation's mean and by how far frequencies pass the bound. Nothing is
differentiated: a plan is a linear program, and what is due in the loop, a plan or none, jumps.

    python studies/learned_room.py two-area --generations 8 --workers 2

Prints each generation's mean; the last one is what was learned.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import cma
import numpy as np
from drawn_operation import DURATION_S, arguments, operated
from threadpoolctl import threadpool_limits

from ded_bench import Case
from ded_bench.methods import surprises
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array
from ded_bench.problem.sampling import sample_scenario
from ded_bench.run.online.loop import LoopOptions

SEED = 4_500_000
#: What is learned, and the largest value of each; the search begins at those of `methods/surprises.py`.
LEARNED = {"ALWAYS": 0.5, "UNCERTAIN": 0.8, "LIMIT": 1.0, "PRICE": 40.0}
#: Candidates, scenarios of a generation, first standard deviation of the logits.
CANDIDATES, SCENARIOS, SIGMA = 6, 6, 0.5
#: What an excess of 1 mHz counts, % of cost. A mean of 0.05 mHz is to count as much as 1 %.
PRICE = 20.0


def judged(case: Case, index: int, values: dict[str, float], options: LoopOptions) -> tuple[float, float]:
    """Cost of a drawn scenario, and its largest excess over the bound, mHz."""
    scenario = sample_scenario(case, SEED, index, servable, DURATION_S)
    found = operated(case, scenario, options, values)
    return found.objective, max(1e3 * found.excess_hz, 0.0)


def values_of(logits: Array) -> dict[str, float]:
    """Values between 0 and the largest of each."""
    return {name: most / (1.0 + np.exp(-x)) for (name, most), x in zip(LEARNED.items(), logits, strict=True)}


def main() -> None:
    """Search, and print each generation."""
    parser = arguments(__doc__)
    parser.add_argument("--generations", type=int, default=8)
    a = parser.parse_args()
    case, options = Case.load(a.case), LoopOptions(period_s=a.period, latency_s=a.latency)
    parts = np.array([getattr(surprises, name) / most for name, most in LEARNED.items()])
    search = cma.CMAEvolutionStrategy(
        np.log(parts / (1.0 - parts)), SIGMA, {"popsize": CANDIDATES, "seed": 1, "verbose": -9}
    )
    with ProcessPoolExecutor(a.workers, initializer=threadpool_limits, initargs=(1,)) as pool:
        for generation in range(a.generations):
            candidates = search.ask()
            drawn = range(generation * SCENARIOS, (generation + 1) * SCENARIOS)
            calls = [
                [pool.submit(judged, case, index, values_of(one), options) for index in drawn]
                for one in candidates
            ]
            found = np.array([[call.result() for call in row] for row in calls])
            cost = 100 * (found[:, :, 0] / found[:, :, 0].mean(axis=0) - 1.0)
            losses = (cost + PRICE * found[:, :, 1]).mean(axis=1)
            search.tell(candidates, losses.tolist())
            told = ", ".join(f"{name} {value:.3g}" for name, value in values_of(search.mean).items())
            print(
                f"{generation + 1}: loss {losses.min():.3f} to {losses.max():.3f}, excess "
                f"{found[:, :, 1].mean(axis=1).min():.4f} to {found[:, :, 1].mean():.4f} mHz; {told}",
                flush=True,
            )


if __name__ == "__main__":
    main()
