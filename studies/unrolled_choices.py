"""What the constants of `ded-dpc-shared` were chosen on: those of its loss, and its iterations.

    python examples/unrolled_choices.py price --case 39bus
    python examples/unrolled_choices.py hopeless --case 39bus
    python examples/unrolled_choices.py iterations --case 39bus
    python examples/unrolled_choices.py learned-iterations --case 39bus --regime NO
    python examples/unrolled_choices.py learned-for --case 39bus --regime NO

The first two train the policy with several prices of the penalty, or several sizes from which it counts less,
some minutes each on one core; weights that are there are not made again. The third gives the committed
weights other numbers of iterations, the fourth learns weights for each number. The last refines answers with
the committed weights only where these were learned for so many iterations. All judge by simulating draws that
no other choice has seen, and print a table.
"""

import argparse
import dataclasses
import unittest.mock
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench import Case, Instance, Schedule, Settings, load_instances, score, solve
from ded_bench.results.reference_run import search_folders
from ded_bench.methods.admm import admm_refined as shared_refined, admm_training as unrolled_training
from ded_bench.methods.admm.admm_policy import SharedPolicy, find_policy
from ded_bench.methods.admm.admm_refined import Refiner
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.problem.benchmark import validation_instances
from ded_bench.plants.lossless.servable import servable

VALUES = {
    "price": (0.05, 0.1, 0.2),
    "hopeless": (0.03, 0.1, 0.3),
    "iterations": (5, 10, 20, 40, 80, 160),
    "learned-iterations": (2, 3, 4, 6, 10),
    "learned-for": (1, 10),
}
#: First validation instance that is judged on, and how many.
FIRST = {
    "iterations": 20_000,
    "price": 20_000,
    "learned-iterations": 20_000,
    "hopeless": 20_200,
    "learned-for": 20_300,
}
DRAWS = {"price": 100, "hopeless": 100, "iterations": 32, "learned-iterations": 32, "learned-for": 32}
#: What a policy answers to one instance.
Answer = Callable[[Instance], Schedule]


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


def answers(case: Case, regime: str, choice: str, folder: Path) -> list[Answer]:
    """One policy for each value of a choice."""
    values = VALUES[choice]
    if choice in ("iterations", "learned-for"):
        own = find_policy(case, regime, Settings(search=search_folders(case)))
        if choice == "learned-for":
            return [refiner(own, value) for value in values]
        policies = [dataclasses.replace(own, training=own.training | {"iterations": n}) for n in values]
    else:
        policies = [trained(case, regime, choice, value, folder) for value in values]
    return [lambda instance, policy=policy: policy(instance)[0] for policy in policies]


def refiner(policy: SharedPolicy, learned_for: int) -> Refiner:
    """The refined policy with another rule of when its weights are taken."""
    with unittest.mock.patch.object(shared_refined, "LEARNED_FOR", learned_for):
        return Refiner.of(policy, learned=True)


def judged(answer: Answer, regime: str, instances: Sequence[Instance], best: Sequence[float]) -> dict:
    """One row of a table: what simulated schedules cost over the best known, and what they violate."""
    scores = [score(i, answer(i), regime=regime) for i in instances]
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
    parser.add_argument("--draws", type=int, help="judge so many (default: 100 or 32)")
    parser.add_argument("--out", default="results/unrolled-choices", help="folder (default: %(default)s)")
    asked = parser.parse_args(arguments)
    case, regime, folder = Case.load(asked.case), asked.regime, Path(asked.out)
    instances = validation_instances(
        case, asked.draws or DRAWS[asked.choice], FIRST[asked.choice], servable=servable
    )
    best = [score(i, solve(i, "ded-slp", regime=regime).schedule, regime=regime).objective for i in instances]
    found = answers(case, regime, asked.choice, folder)
    table = pd.DataFrame(
        {asked.choice: value} | judged(answer, regime, instances, best)
        for value, answer in zip(VALUES[asked.choice], found, strict=True)
    )
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / f"{asked.choice}-{case.id}-{regime}.csv", index=False)
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
