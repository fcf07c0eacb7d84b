"""A trained method in one module: a constant schedule, whose powers are learned (badly)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.methods.options import option, read_options
from ded_bench.methods.registry import Method
from ded_bench.methods.solution import Artifact, Settings, Solution, Solver, model_artifact
from ded_bench.methods.training_record import TrainingOptions, find_policy_file, write_history
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

VERSION = 1


@dataclass(frozen=True)
class Options:
    """How it answers."""

    slope: float = option(0.0, "pu per second")


#: The line of the registry.
LEARNED = Method("learned", "tests.learned_method", "Learned constant", trainer="tests.learned_method")


@dataclass(frozen=True)
class Policy:
    training: dict[str, Any]


def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> Policy:
    """The generators' mean initial powers, approached from their lower limits."""
    epochs, share, model = options.epochs or 3, 0.5, options.find_model(case)
    mean = np.mean([i.p_initial(case) for i in instances], axis=0)
    first = float(np.sum((mean - case.p_min) ** 2))
    errors = [first * (1.0 - share) ** (2 * epoch) for epoch in range(1, epochs + 1)]
    power = mean + (case.p_min - mean) * (1.0 - share) ** epochs
    facts = options.facts() | {"epochs": epochs, "seconds": 0.0, "training_loss": errors[-1]}
    write_arrays(out, {"power": power}, {"training": facts | {"model": model.kind}})
    write_history(out, [{"epoch": e, "seconds": 0.0, "training": error} for e, error in enumerate(errors, 1)])
    return Policy(facts)


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    path = find_policy_file(LEARNED.name, case, regime, settings)
    power = read_arrays(path)[0]["power"]
    return Artifact("policy", LEARNED.name, power.tobytes().hex()[:12], path), model_artifact(case, settings)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    power = read_arrays(find_policy_file(LEARNED.name, case, regime, settings))[0]["power"]
    slope = read_options(Options, settings.options).slope

    def solve(instance: Instance) -> Solution:
        schedule = Schedule(
            np.array([0.0, instance.horizon_s]), np.array([power, power + slope * instance.horizon_s])
        )
        return Solution(Status.POLICY, schedule, solve_s=1e-6)

    return solve
