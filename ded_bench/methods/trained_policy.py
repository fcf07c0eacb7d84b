"""A trained policy as a method: its weights, and one answer, timed from the instance to the powers."""

from __future__ import annotations

import abc
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numba
import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.policy_file import (
    Scope,
    Weights,
    checked_weights,
    find_policy_file,
    read_policy,
    weights_fingerprint,
    write_policy,
)
from ded_bench.methods.solution import Artifact, Settings, Solution, Solver
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

#: Instances answered at a time.
CHUNK = 50
SOLVER_VERSION = f"numba {numba.__version__}, numpy {np.__version__}"


@dataclass(frozen=True, eq=False)
class TrainedPolicy(abc.ABC):
    """Weights with all that is needed to answer: powers on the same knots whatever the instance."""

    method: ClassVar[str]
    scope: Scope
    weights: Weights
    training: dict[str, Any]  # facts of the training, and of what was trained

    @abc.abstractmethod
    def answers(self, instances: Sequence[Instance]) -> Array:
        """Powers at the knots of instances within the scope, (batch, n_knots, n_gen), pu."""

    @staticmethod
    @abc.abstractmethod
    def shapes(
        scope: Scope, training: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights that a file with these facts must have.

        Raises:
            ValueError: the facts are missing, mistyped or contradict the arrays.
        """

    @functools.cached_property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return self.scope.case.knot_times(self.scope.horizon_s)

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.weights)

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon, or cannot be served.
            PowerFlowError: an instance has no equilibrium at t = 0.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self.scope.check(batch)
        parts = (batch[i : i + CHUNK] for i in range(0, len(batch), CHUNK))
        return [Schedule(self.knots, p) for part in parts for p in self.answers(part)]

    def save(self, path: Path) -> None:
        """Write weights and header."""
        write_policy(path, self.method, self.scope, self.weights, self.training)

    @classmethod
    def load(cls, path: str | Path, case: Case, regime: str) -> Self:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, cls.method, case, regime)
        try:
            shapes = cls.shapes(scope, training, arrays)
        except ValueError as error:
            raise InputError(path, "training", str(error)) from None
        return cls(scope, checked_weights(arrays, shapes, path), training)

    @classmethod
    def find(cls, case: Case, regime: str, settings: Settings) -> Self:
        """Load the policy given in the settings, else the first one in the folders to search.

        Raises:
            InputError: there is none (names the command that trains one), or it does not fit.
        """
        return cls.load(find_policy_file(cls.method, case, regime, settings), case, regime)

    @classmethod
    def artifacts(cls, case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
        """The policy that `find` loads; raises as it does."""
        path = find_policy_file(cls.method, case, regime, settings)
        return (Artifact("policy", cls.method, cls.load(path, case, regime).fingerprint, path),)


def as_solver(scope: Scope, answer: Callable[[Instance], Schedule], iterations: int | None = None) -> Solver:
    """Return a policy as a method; `solve_s` is all from the instance to the powers at the knots.

    What the first answer costs (compilation, libraries, tables) is paid here, by a draw of policy training,
    so that no answer is computed twice.
    """

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        schedule = answer(instance)
        elapsed = time.perf_counter() - started
        return Solution(Status.POLICY, schedule, iterations, solve_s=elapsed, solver_version=SOLVER_VERSION)

    instance = sample_instance(scope.case, POLICY_SEED, 0, servable)
    solve(instance.model_copy(update={"horizon_s": scope.horizon_s}))
    return solve
