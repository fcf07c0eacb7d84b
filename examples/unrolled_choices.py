"""What the constants of `ded-dpc-shared` were chosen on: those of its loss, and its iterations.

    python examples/unrolled_choices.py price --case 39bus
    python examples/unrolled_choices.py hopeless --case 39bus
    python examples/unrolled_choices.py iterations --case 39bus
    python examples/unrolled_choices.py learned-iterations --case 39bus --regime NO

The first two train the policy with several prices of the penalty, or several sizes from which it counts less,
some minutes each on one core; weights that are there are not made again. The third gives the committed
weights other numbers of iterations, the last learns weights for each number. All judge by simulating draws
that no other choice has seen, and print a table.
"""

import argparse
import dataclasses
import unittest.mock
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

VALUES = {
    "price": (0.05, 0.1, 0.2),
    "hopeless": (0.03, 0.1, 0.3),
    "iterations": (5, 10, 20, 40, 80, 160),
    "learned-iterations": (2, 3, 4, 6, 10),
}
#: First validation instance that is judged on, and how many.
FIRST = {"price": 20_000, "hopeless": 20_200, "iterations": 20_000, "learned-iterations": 20_000}
DRAWS = {"price": 100, "hopeless": 100, "iterations": 32, "learned-iterations": 32}


def trained(case: Case, regime: str, choice: str, value: float, folder: Path) -> SharedPolicy:
    """The policy trained with another constant, in a file of its own."""
    out = folder / f"{case.id}-{regime}-{choice}-{value:g}.safetensors"
    if not out.exists():
        folder.mkdir(parents=True, exist_ok=True)
        instances = load_instances(case.id, split="train")
        variants = {"price": {"price": value}, "learned-iterations": {"iterations": int(value)}}
        hopeless = value if choice == "hopeless" else unrolled_training.HOPELESS
        with unittest.mock.patch.object(unrolled_training, "HOPELESS", hopeless):
            given = case, regime, instances, None, out, TrainingOptions()
            unrolled_training.train(*given, **variants.get(choice, {}))
    return SharedPolicy.load(out, case, regime)


def judged(policy: SharedPolicy, instances: Sequence[Instance], best: Sequence[float]) -> dict:
    """One row of a table: what simulated schedules cost over the best known, and what they violate."""
    regime = policy.scope.regime
    scores = [score(i, s, regime=regime) for i, s in zip(instances, policy(instances), strict=True)]
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
    parser.add_argument("choice", choices=tuple(VALUES))
    parser.add_argument("--case", default="39bus", help="a shipped case (default: %(default)s)")
    parser.add_argument("--regime", default="TO", help="of the case (default: %(default)s)")
    parser.add_argument("--draws", type=int, help="judge so many (default: 32 by iterations, else 100)")
    parser.add_argument("--out", default="results/unrolled-choices", help="folder (default: %(default)s)")
    asked = parser.parse_args(arguments)
    case, regime, folder = Case.load(asked.case), asked.regime, Path(asked.out)
    instances = validation_instances(
        case, asked.draws or DRAWS[asked.choice], FIRST[asked.choice], servable=servable
    )
    best = [score(i, solve(i, "ded-slp", regime=regime).schedule, regime=regime).objective for i in instances]
    values = VALUES[asked.choice]
    if asked.choice == "iterations":
        own = find_policy(case, regime, Settings(search=search_folders(case)))
        policies = [dataclasses.replace(own, training=own.training | {"iterations": n}) for n in values]
    else:
        policies = [trained(case, regime, asked.choice, value, folder) for value in values]
    table = pd.DataFrame(
        {asked.choice: value} | judged(policy, instances, best)
        for value, policy in zip(values, policies, strict=True)
    )
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / f"{asked.choice}-{case.id}-{regime}.csv", index=False)
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
