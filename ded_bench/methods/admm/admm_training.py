"""Train `ded-admm` on problems drawn afresh for every step; no solution is needed, and no surrogate."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ded_bench.files.errors import InputError
from ded_bench.methods.admm.admm_inference import PRICE
from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.methods.admm.modal_grid import ModalGrid, Start
from ded_bench.methods.admm.problems import draw, problems_of
from ded_bench.methods.admm.torch_iterations import TorchIterations, judged
from ded_bench.methods.island.island_training import train as train_on_island
from ded_bench.methods.trained_policy import Scope, TrainedPolicy, weights_of
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.methods.training_run import TrainingRun, looked, repeatable
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED

#: Iterations of an answer: the fewest, and times generators on small grids, where they take less time. Where
#: the bound on |ω| is loose, a few go almost as far (studies/admm.md).
TIGHT, LOOSE = (5, 45), (3, 30)
#: Steps of an epoch, epochs.
STEPS, EPOCHS = 100, 8
#: Problems of a step: so many that generators times knots of all are near the first number.
ROWS, SMALLEST_BATCH = 4000, 8
LEARNING_RATE = 0.1
#: The policy is trained on a bound tighter by this fraction, so that small excesses stay within the true one.
MARGIN = 0.015
#: Penalty, as a part of an instance's cost, of which half counts: a few instances have no feasible schedule,
#: and would else be all that is learned from.
HOPELESS = 0.1
#: Most instances on which weights are compared.
HELD_OUT = 100
#: Margins of the answering policy that are tried by simulation, as fractions of the bound, in this order.
MARGINS = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.2, 0.25)
#: The first that keeps so large a part of the instances within the scorer's tolerance is taken.
WANTED = 0.98
#: Most instances that are simulated with each margin.
SIMULATED = 50


@repeatable()
def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> TrainedPolicy:
    """Train a policy; see `training_record.Trainer`.

    Args:
        instances: choose the best weights and the margin, and are never trained on, but for islands.
    """
    if options.model:
        raise InputError("--model", options.model, f"{AdmmPolicy.method} is trained without a surrogate")
    if case.slack is None:
        return train_on_island(case, regime, instances, out, options)
    horizon = instances[0].horizon_s
    grid = ModalGrid(case, case.omega_bound(regime), horizon)
    fewest, rounds = TIGHT if grid.coarse.is_tight else LOOSE
    network = TorchIterations(grid, max(fewest, rounds // len(case.generators)))
    check = grid.start(problems_of(case, instances[:HELD_OUT], grid.points))
    run = _AdmmTraining(network, check, options.seed, out)
    with np.errstate(over="ignore", invalid="ignore"):  # a draw may swing up without end
        facts = run.train(options, EPOCHS, f"{AdmmPolicy.method} {regime}", case.fingerprint)
    facts |= {
        "batch": run.batch,
        "instances": run.step * run.batch,
        "held_out": len(check.served),
        "iterations": len(network.start),
    }
    policy = with_margin(AdmmPolicy(Scope(case, regime, horizon), weights_of(network), facts), instances)
    policy.save(out)
    return policy


class _AdmmTraining(TrainingRun):
    def __init__(self, network: TorchIterations, check: Start, seed: int, out: Path) -> None:
        optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.99))
        super().__init__(network, optimiser, seed, out)
        case = network.grid.case
        self.grid, self.check, self.seed = network.grid, check, seed
        self.batch = max(SMALLEST_BATCH, ROWS // (len(case.generators) * case.n_knots))

    def batches(self) -> Sequence[int]:
        """Seeds of the steps: a training that goes on draws what it would have drawn."""
        return range(self.step, self.step + STEPS)

    def loss(self, step: int, progress: float) -> Tensor | None:
        """Cost and priced penalty of fresh draws."""
        grid, drawn = self.grid, (POLICY_SEED + self.seed, step * self.batch, self.batch)
        start = grid.start(draw(grid.case, grid.bound, grid.points, *drawn))
        cost, penalty, _ = judged(grid, start, self.network(start), MARGIN)
        used = torch.as_tensor(start.served)
        penalty = PRICE * penalty
        return (cost + penalty / (1.0 + penalty / HOPELESS))[used].mean() if used.any() else None

    def look(self) -> dict[str, float]:
        """Loss of the average, its cost, and what it exceeds, Hz."""
        answer = self.average(self.check)
        cost, penalty, _ = judged(self.grid, self.check, answer, MARGIN)
        hertz = judged(self.grid, self.check, answer)[2] * self.grid.bound / (2 * math.pi)
        return looked((cost + PRICE * penalty).mean(), cost, hertz)


def with_margin(policy: AdmmPolicy, instances: Sequence[Instance]) -> AdmmPolicy:
    """The policy with the least margin that makes enough of its schedules feasible on the true system.

    Where no margin does, the one with most feasible schedules of those tried, and of several the least.

    Args:
        policy: trained; its margin so far counts for nothing.
        instances: not those that it will be judged on. Those that cannot be scored count as infeasible.
    """
    found: list[tuple[float, AdmmPolicy]] = []
    case, regime, chosen = policy.scope.case, policy.scope.regime, instances[:SIMULATED]
    for margin in MARGINS:
        tried, kept = dataclasses.replace(policy, training=policy.training | {"margin": margin}), 0
        for instance, schedule in zip(chosen, tried(chosen), strict=True):
            with contextlib.suppress(SimulationError):
                kept += score(case, instance, schedule, regime).feasible
        share = kept / len(chosen)
        facts = tried.training | {"margin_feasible": share, "margin_instances": len(chosen)}
        found.append((share, dataclasses.replace(tried, training=facts)))
        if share >= WANTED:
            break
    return max(found, key=lambda pair: pair[0])[1]
