"""Weights of `ded-admm` by CMA-ES instead of gradients.

Run as `python studies/admm_derivative_free.py 39bus TO 284`; needs `pip install cma`. The search minimises
the loss of the training on fresh draws, the same for all candidates of a generation, with the compiled
iterations, for so many CPU seconds (those of the training by gradients stand in the policy's file). Of
running means of the distribution's mean the one with the least loss on training instances is kept, as in
training. Then both weights answer fresh validation draws.
"""

import dataclasses
import sys
import time

import cma
import numpy as np

from ded_bench import Case
from ded_bench.methods.admm.admm_inference import (
    DOUBLING,
    NODES,
    PRICE,
    SETTINGS,
    STRAIGHT,
    CompiledIterations,
)
from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.methods.admm.admm_training import HELD_OUT, HOPELESS, MARGIN
from ded_bench.methods.admm.modal_grid import ModalGrid
from ded_bench.methods.admm.problems import draw, problems_of
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.plants.plant import servable
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import select_split, validation_instances
from ded_bench.problem.case import Array
from ded_bench.problem.sampling import POLICY_SEED
from ded_bench.results.folder import reference_run

SHAPE = NODES, len(SETTINGS)
#: Problems of a generation, candidates, first standard deviation, generations between looks.
BATCH, CANDIDATES, SIGMA, LOOK = 16, 14, 0.5, 10
#: Of the running mean, once there are ten generations.
KEEP = 0.9
#: Validation draws: none that a choice was made on before.
VALIDATION, FIRST = 64, 30_000


class Judge:
    """Problems of one grid, prepared once for all candidates."""

    def __init__(self, grid: ModalGrid, iterations: int, problems: StackedInstances) -> None:
        self.grid, self.iterations, self.start = grid, iterations, grid.start(problems)
        self.linear = grid.along_first(self.start)
        self.served = self.start.served.copy()

    def __call__(self, weights: Array) -> tuple[Array, Array]:
        """Relative cost and priced penalty, on a bound tightened as in training, (batch,)."""
        grid, start = self.grid, self.start
        iterate = CompiledIterations(grid, grid.bound, weights.reshape(SHAPE), self.iterations)
        powers = iterate(start, self.linear, start.schedule)
        x = grid.respond(powers, start, self.linear)[0]
        _, omega, p_slack = grid.respond(powers, start, grid.along(start, x))
        cost, mean = start.problems.cost, [_means(n) for n in (powers.shape[1], p_slack.shape[1])]
        total = (powers @ cost[:, 1:, None])[:, :, 0] @ mean[0] + cost[:, 0] * (np.abs(p_slack) @ mean[1])
        excess = np.maximum(np.abs(omega) / grid.bound - (1.0 - MARGIN), 0.0)
        bent = np.minimum(excess, STRAIGHT)
        penalty = (excess + (excess - 0.5 * bent) * bent / DOUBLING).sum(axis=(1, 2)) * grid.points[1]
        return (total / start.scale)[self.served], PRICE * penalty[self.served]

    def training_loss(self, weights: Array) -> float:
        """Large penalties count by half of `HOPELESS`, as in training."""
        cost, penalty = self(weights)
        return float(np.nan_to_num((cost + penalty / (1.0 + penalty / HOPELESS)).mean(), nan=1e3, posinf=1e3))


def _means(n: int) -> Array:
    weights = np.full(n, 1.0 / (n - 1))
    weights[[0, -1]] *= 0.5
    return weights


def search(case: Case, policy: AdmmPolicy, seconds: float) -> Array:
    """The best weights that so many CPU seconds find; prints each look."""
    grid = ModalGrid(case, case.omega_bound(policy.scope.regime), policy.scope.horizon_s)
    iterations = policy.training["iterations"]
    instances = [one for one, _ in select_split(case.id, "train", HELD_OUT).instances]
    check = Judge(grid, iterations, problems_of(case, instances, grid.points))
    known = sum(part.mean() for part in check(policy.weights["nodes"]))
    print(f"held out, gradients: {known:.6f}", flush=True)
    es = cma.CMAEvolutionStrategy(
        np.zeros(SHAPE).ravel(), SIGMA, {"popsize": CANDIDATES, "seed": 1, "verbose": -9}
    )
    mean, best, least, spent, generation = np.zeros(SHAPE).ravel(), np.zeros(SHAPE).ravel(), np.inf, 0.0, 0
    while spent < seconds:
        began = time.process_time()
        drawn = draw(case, grid.bound, grid.points, POLICY_SEED, generation * BATCH, BATCH)
        judge, candidates = Judge(grid, iterations, drawn), es.ask()
        es.tell(candidates, [judge.training_loss(one) for one in candidates])
        generation += 1
        mean += (es.result.xfavorite - mean) * max(1.0 - KEEP, 1.0 / generation)
        spent += time.process_time() - began
        if generation % LOOK == 0 or spent >= seconds:
            cost, penalty = (part.mean() for part in check(mean))
            if cost + penalty < least:
                best, least = mean.copy(), cost + penalty
            print(
                f"{generation} generations, {spent:.0f} s: held out {cost + penalty:.6f}, cost {cost:.6f}",
                flush=True,
            )
    return best


def compare(case: Case, policies: dict[str, AdmmPolicy]) -> None:
    """Simulate the answers of all to the same draws; costs are relative to the first's."""
    draws, first = list(validation_instances(case, VALIDATION, FIRST, servable=servable)), None
    for name, policy in policies.items():
        found = [score(case, i, s, policy.scope.regime) for i, s in zip(draws, policy(draws), strict=True)]
        cost, excess = np.array([(one.objective, one.freq_violation_hz) for one in found]).T
        first = cost if first is None else first
        more = 100 * (cost / first - 1)
        error = more.std() / np.sqrt(len(more))
        print(
            f"{name}: cost {more.mean():+.4f} ± {error:.4f} %, violation {excess.mean():.1e} Hz in the mean, "
            f"{excess.max():.1e} at most, feasible {sum(one.feasible for one in found)} of {len(found)}"
        )


def main(name: str, regime: str, seconds: float) -> None:
    """Search, then compare."""
    case = Case.load(name)
    path = reference_run(case) / "policies" / f"ded-admm-{regime}.safetensors"
    policy = AdmmPolicy.load(path, case, regime)
    print(f"{name} {regime}: training by gradients took {policy.training['cpu_seconds']:.0f} s of CPU")
    found = {"nodes": search(case, policy, seconds).reshape(SHAPE).astype(np.float32)}
    compare(case, {"gradients": policy, "CMA-ES": dataclasses.replace(policy, weights=found)})


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
