"""What the constants of `ded-dpc-shared` were chosen on: the price of its penalty, and its iterations.

    python examples/unrolled_choices.py price --case 39bus
    python examples/unrolled_choices.py iterations --case 39bus

The first trains the policy with several prices, some minutes each on one core; weights that are there are
not made again. Both judge by simulating draws that no other choice has seen, and print a table.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench import Case, Instance, Settings, load_instances, score, solve
from ded_bench.koopman.reference_run import search_folders
from ded_bench.methods.dpc_shared import unrolled_training
from ded_bench.methods.dpc_shared.shared_policy import SharedPolicy, find_policy
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.problem.benchmark import validation_instances
from ded_bench.truth.servable import servable

REGIME = "TO"
PRICES = (0.05, 0.1, 0.2)
ITERATIONS = (5, 10, 20, 40, 80, 160)
#: First validation instance that is judged on, and how many.
FIRST, DRAWS = 20_000, {"price": 100, "iterations": 32}


def priced(case: Case, price: float, folder: Path) -> SharedPolicy:
    """The policy trained with a price, in a file of its own."""
    out = folder / f"{case.id}-{price:g}.safetensors"
    if not out.exists():
        folder.mkdir(parents=True, exist_ok=True)
        instances = load_instances(case.id, split="train")
        unrolled_training.train(case, REGIME, instances, None, out, TrainingOptions(), price=price)
    return SharedPolicy.load(out, case, REGIME)


def judged(policy: SharedPolicy, instances: Sequence[Instance], best: Sequence[float]) -> dict:
    """One row of a table: what simulated schedules cost over the best known, and what they violate."""
    scores = [score(i, s, regime=REGIME) for i, s in zip(instances, policy(instances), strict=True)]
    gaps = 100.0 * (np.array([s.objective for s in scores]) / best - 1.0)
    excess = np.array([s.freq_violation_hz for s in scores])
    return {
        "gap_percent": gaps.mean(),
        "p95_percent": np.quantile(gaps, 0.95),
        "mean_violation_hz": excess.mean(),
        "largest_violation_hz": excess.max(),
        "feasible": sum(s.feasible for s in scores),
        "n": len(scores),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and write it to the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("choice", choices=("price", "iterations"))
    parser.add_argument("--case", default="39bus", help="a shipped case (default: %(default)s)")
    parser.add_argument("--draws", type=int, help="judge so many (default: 100 by price, 32 by iterations)")
    parser.add_argument("--out", default="results/unrolled-choices", help="folder (default: %(default)s)")
    asked = parser.parse_args(arguments)
    case, folder = Case.load(asked.case), Path(asked.out)
    instances = validation_instances(case, asked.draws or DRAWS[asked.choice], FIRST, servable=servable)
    best = [score(i, solve(i, "ded-slp", regime=REGIME).schedule, regime=REGIME).objective for i in instances]
    if asked.choice == "price":
        policies = {price: priced(case, price, folder) for price in PRICES}
    else:
        own = find_policy(case, REGIME, Settings(search=search_folders(case)))
        policies = {
            n: dataclasses.replace(own, training=own.training | {"iterations": n}) for n in ITERATIONS
        }
    table = pd.DataFrame(
        {asked.choice: n} | judged(policy, instances, best) for n, policy in policies.items()
    )
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / f"{asked.choice}-{case.id}.csv", index=False)
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
