"""Weights of `ded-dpc-shared` on grids that they were not learned on, and one set learned on several grids.

    python examples/one_policy.py --regime TO --out results/one-policy

Every step of the common training adds the gradients of one batch of each grid. Some ten minutes on one core;
weights that are there are not made again. Judges by simulating validation draws, and prints a table.
"""

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from ded_bench import Case, Settings, score, solve
from ded_bench.results.reference_run import search_folders
from ded_bench.methods.admm.drawn_problems import draw
from ded_bench.methods.admm.grid_response import GridResponse
from ded_bench.methods.admm.path_model import PathModel
from ded_bench.methods.admm.admm_policy import SharedPolicy, find_policy
from ded_bench.methods.admm.admm_iterations import UnrolledIterations
from ded_bench.methods.admm.admm_loss import MARGIN, ScheduleLoss
from ded_bench.methods.admm.admm_training import (
    AVERAGE,
    CLIP_NORM,
    HOPELESS,
    LEARNING_RATE,
    PRICE,
    batch_of,
    iterations_of,
    read_start,
)
from ded_bench.methods.policy_file import Weights
from ded_bench.problem.benchmark import validation_instances
from ded_bench.plants.lossless.servable import servable

#: Grids of the training, and on how many draws each grid is judged; the last is never trained on.
TRAINED = ("two-area", "39bus", "68bus")
#: Grids whose own weights are judged on the others.
KNOWN = ("two-area", "39bus")
DRAWS = {"two-area": 32, "39bus": 24, "68bus": 8, "140bus": 4}
#: First validation instance that is judged on.
FIRST = 20_100
#: Steps of the training, as many as for one grid.
STEPS = 800


def unrolled(name: str, regime: str) -> UnrolledIterations:
    """The iterations on a grid, with the weights where training starts."""
    case = Case.load(name)
    response = GridResponse.make(case, case.knot_times(case.sampling.horizon_s))
    model = PathModel(case, case.omega_bound(regime), response)
    return UnrolledIterations(model, iterations_of(model))


def train(grids: Sequence[UnrolledIterations], steps: int) -> None:
    """Train weights on all grids together; the mean of the last ones is left in each."""
    nodes = grids[0].nodes
    for grid in grids:
        grid.nodes = nodes
    average, generator = nodes.detach().clone(), np.random.default_rng(0)
    optimiser = torch.optim.Adam([nodes], lr=LEARNING_RATE, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda i: 0.5 + 0.5 * math.cos(math.pi * i / steps)
    )
    for i in range(steps):
        optimiser.zero_grad()
        for grid in grids:
            model = grid.model
            drawn = draw(model.case, model.bound, model.response.fine, batch_of(model.case), generator)
            outset = model.outset(drawn)
            judged = ScheduleLoss(model)(outset, grid(outset), MARGIN)
            penalty = PRICE * judged.penalty
            losses = judged.cost + penalty / (1.0 + penalty / HOPELESS)
            losses[torch.as_tensor(outset.served)].mean().backward()
        if torch.isfinite(torch.nn.utils.clip_grad_norm_([nodes], CLIP_NORM)):
            optimiser.step()
        schedule.step()
        average.lerp_(nodes.detach(), 1.0 - min(AVERAGE, 1.0 - 1.0 / (1.0 + (i + 1) / 10.0)))
    with torch.no_grad():
        nodes.copy_(average)


def find_own(name: str, regime: str) -> SharedPolicy:
    """The policy of a grid's reference run."""
    case = Case.load(name)
    return find_policy(case, regime, Settings(search=search_folders(case)))


def judged_on(name: str, regime: str, common: Weights, draws: int) -> list[dict]:
    """Rows of the weights of all grids, of a grid's own and of others' on it, over `ded-slp`."""
    own = find_own(name, regime)
    facts = {"iterations": own.training["iterations"]}
    known = {"of all": dataclasses.replace(own, weights=common, training=facts), "its own": own}
    for other in KNOWN:
        if other != name:  # with its number of iterations and its margin
            known[f"of {other}"] = dataclasses.replace(find_own(other, regime), scope=own.scope)
    case = own.scope.case
    instances = validation_instances(case, draws, FIRST, servable=servable)
    best = [score(i, solve(i, "ded-slp", regime=regime).schedule, regime=regime).objective for i in instances]
    rows = []
    for words, policy in known.items():
        scores = [score(i, s, regime=regime) for i, s in zip(instances, policy(instances), strict=True)]
        excess = 1e3 * np.array([s.freq_violation_hz for s in scores])
        rows.append(
            {
                "grid": name,
                "weights": words,
                "n": len(scores),
                "gap_percent": 100.0 * float(np.mean([s.objective for s in scores] / np.array(best) - 1.0)),
                "violation_mhz": excess.mean(),
                "largest_mhz": excess.max(),
                "feasible": sum(s.feasible for s in scores),
            }
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, judge, print the table and write it to the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--regime", default="TO", help="(default: %(default)s)")
    parser.add_argument("--steps", type=int, default=STEPS, help="of the training (default: %(default)s)")
    parser.add_argument("--draws", type=int, help="judge at most so many")
    parser.add_argument("--out", default="results/one-policy", help="folder (default: %(default)s)")
    asked = parser.parse_args(arguments)
    folder = Path(asked.out)
    weights = folder / f"weights-{asked.regime}.safetensors"
    if not weights.exists():
        folder.mkdir(parents=True, exist_ok=True)
        grids = [unrolled(name, asked.regime) for name in TRAINED]
        train(grids, asked.steps)
        scope = find_own(TRAINED[0], asked.regime).scope
        SharedPolicy.of(scope, grids[0], {}).save(weights)
    common = read_start(weights)
    rows: list[dict] = []
    for name, most in DRAWS.items():
        rows += judged_on(name, asked.regime, common, min(most, asked.draws or most))
    table = pd.DataFrame(rows)
    table.to_csv(folder / f"table-{asked.regime}.csv", index=False)
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
