"""Train `ded-admm` on an island: CMA-ES on its seven settings, judged by the scorer.

Instances are not drawn afresh, since each would have to be simulated to see that it can be served: candidates
are compared on a few of those given, others in every generation, and the last ones are held out.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from pathlib import Path

import cma
import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.island.island_iterations import IslandGrid
from ded_bench.methods.island.island_policy import IslandPolicy
from ded_bench.methods.trained_policy import Scope
from ded_bench.methods.training_record import TrainingOptions, write_history
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: Iterations of each round with costs, few or many, and of mending.
ITERATIONS, MANY, MENDING = 12, 28, 10
#: What a second round, many iterations, steps half as long, or simulating everything must gain, as a part of
#: cost: each takes time.
WORTH = 3e-4
#: Candidates of a generation, instances on which they are compared, generations of an epoch, epochs.
CANDIDATES, BATCH, GENERATIONS, EPOCHS = 8, 16, 5, 8
#: Where the search starts, and its first standard deviation.
FIRST = np.log([0.2, 0.25, 2.5, 0.2, 20.0, 0.3, 0.1])
SIGMA = 0.4
#: Most instances that are held out, and that tell what is worth its time: few answers break a limit.
HELD_OUT, TELLING = 40, 200
#: What an answer that breaks a limit counts for, and one that cannot be simulated, as parts of cost.
INFEASIBLE, HOPELESS = 0.02, 0.05


def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> IslandPolicy:
    """Train a policy; see `training_record.Trainer`.

    Raises:
        InputError: training is to go on, or no instance is left to hold out.
    """
    if options.resume:
        raise InputError("--resume", "", "policies of islands train in minutes, and start anew")
    if len(instances) < 2:
        raise InputError("--limit", str(len(instances)), "is too few: one instance is held out")
    facts = options.facts() | {"rounds": 2, "iterations": ITERATIONS, "mending": MENDING}
    facts |= {"substeps": 1, "quick": True}
    scope = Scope(case, regime, instances[0].horizon_s)
    held = min(HELD_OUT, len(instances) // 2)
    trained, check = instances[: len(instances) - held], instances[len(instances) - held :]

    def policy(settings: Array) -> IslandPolicy:
        return IslandPolicy(scope, {"settings": settings.astype(np.float32)}, facts)

    random, began = np.random.default_rng(options.seed), time.perf_counter()
    own = {"popsize": CANDIDATES, "randn": lambda *shape: random.standard_normal(shape)}
    search = cma.CMAEvolutionStrategy(FIRST, SIGMA, own | {"seed": np.nan, "verbose": -9})
    history: list[dict[str, float]] = []
    telling = instances[-TELLING:]
    best, least = FIRST, loss(policy(FIRST), telling)
    for name, count, most in (("substeps", 2, -WORTH), ("rounds", 1, WORTH), ("iterations", MANY, -WORTH)):
        usual, facts[name] = facts[name], count
        if (other := loss(policy(FIRST), telling)) >= least + most:
            other, facts[name] = least, usual
        least = other
    drawn, best_loss = itertools.cycle(trained), loss(policy(FIRST), check)
    for epoch in range(options.epochs or EPOCHS):
        for _ in range(GENERATIONS):
            batch, candidates = list(itertools.islice(drawn, BATCH)), search.ask()
            search.tell(candidates, [loss(policy(one), batch) for one in candidates])
        found, spent = loss(policy(search.mean), check), time.perf_counter() - began
        history.append({"epoch": epoch + 1, "seconds": spent, "held out": found})
        if found < best_loss:
            best, best_loss = search.mean.copy(), found
        if options.seconds is not None and spent >= options.seconds:
            break
    write_history(out, history)
    of_quick, facts["quick"] = loss(policy(best), instances), False
    facts["quick"] = loss(policy(best), instances) > of_quick - WORTH
    best_loss = loss(policy(best), check)
    facts |= {"epochs": len(history), "seconds": time.perf_counter() - began, "held_out_loss": best_loss}
    facts |= {"instances": len(trained), "held_out": held, "cma": cma.__version__}
    made = policy(best)
    made.save(out)
    return made


def loss(policy: IslandPolicy, instances: Sequence[Instance]) -> float:
    """Mean of what answers cost beyond the schedules that they start from, as a part; what fails counts."""
    return float(np.mean([_one(policy, policy.grid, instance) for instance in instances]))


def _one(policy: IslandPolicy, grid: IslandGrid, instance: Instance) -> float:
    asked = grid.ask(instance)
    try:
        answer = Schedule(policy.knots, policy.powers(instance))
        found = score(policy.scope.case, instance, answer, policy.scope.regime)
        _, delivered = grid.coarse.follow(asked.begun, grid.hat @ asked.start)
    except SimulationError:
        return HOPELESS
    start = float(grid.weight @ delivered @ asked.cost) * (instance.steps + 1)
    return found.objective / start - 1.0 + (0.0 if found.feasible else INFEASIBLE)
