"""A trained policy as a method: its weights, and one answer, timed; torch is for training alone."""

from __future__ import annotations

import abc
import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numba
import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Artifact, Settings, Solution, Solver
from ded_bench.methods.training_record import find_policy_file
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

if TYPE_CHECKING:
    from torch import nn

#: Files of the first kind have fingerprints of their weights alone.
SCHEMAS = "ded-bench/policy/1", "ded-bench/policy/2"
#: Instances answered at a time.
CHUNK = 50
SOLVER_VERSION = f"numba {numba.__version__}, numpy {np.__version__}"
#: Weights and buffers of a network by name, in the order of its state dict, float32.
Weights = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Scope:
    """What a policy was trained for: it answers nothing else."""

    case: Case
    regime: str
    horizon_s: float

    def check(self, instances: Sequence[Instance]) -> None:
        """Raise InputError if an instance belongs to another case or horizon."""
        for instance in instances:
            source = f"instance {instance.id}"
            if instance.case != self.case.id:
                raise InputError(source, "case", f"the policy is for case {self.case.id}")
            if abs(instance.horizon_s - self.horizon_s) > 1e-9:
                raise InputError(source, "horizon_s", f"the policy is for a horizon of {self.horizon_s} s")


@dataclass(frozen=True, eq=False)
class TrainedPolicy(abc.ABC):
    """Weights with all that is needed to answer: powers on the same knots whatever the instance."""

    method: ClassVar[str]
    #: Facts of the training that answers depend on.
    deciding: ClassVar[tuple[str, ...]] = ()
    scope: Scope
    weights: Weights
    training: dict[str, Any]  # facts of the training, and of what was trained
    schema: str = SCHEMAS[-1]

    @abc.abstractmethod
    def answers(self, instances: Sequence[Instance]) -> Array:
        """Powers at the knots of instances within the scope, (batch, n_knots, n_gen), pu."""

    @staticmethod
    @abc.abstractmethod
    def shapes(case: Case, training: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights that a file with these facts must have.

        Raises:
            ValueError: the facts are missing or mistyped.
        """

    @functools.cached_property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return self.scope.case.knot_times(self.scope.horizon_s)

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does, or else what decides on answers."""
        digest = hashlib.sha256(b"".join(w.tobytes() for w in self.weights.values()))
        if self.schema != SCHEMAS[0]:
            facts = [self.scope.horizon_s, *(self.training.get(name) for name in self.deciding)]
            digest.update(json.dumps(facts).encode())
        return digest.hexdigest()[:12]

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon, or cannot be served.
            SimulationError: an instance has no equilibrium at t = 0.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self.scope.check(batch)
        parts = (batch[i : i + CHUNK] for i in range(0, len(batch), CHUNK))
        return [Schedule(self.knots, p) for part in parts for p in self.answers(part)]

    def save(self, path: Path) -> None:
        """Write weights and header."""
        facts = {"schema": self.schema, "horizon_s": self.scope.horizon_s, "training": self.training}
        write_arrays(path, self.weights, self._header(self.scope.case, self.scope.regime) | facts)

    @classmethod
    def _header(cls, case: Case, regime: str) -> dict[str, Any]:
        """What tells policies apart."""
        of_case = {"case": case.id, "case_fingerprint": case.fingerprint}
        return {"method": cls.method} | of_case | {"regime": regime}

    @classmethod
    def load(cls, path: str | Path, case: Case, regime: str) -> Self:
        """Read a policy for a case and regime.

        Raises:
            InputError: the file is wrong, or the policy is for another case, its limits changed, or for
                another regime or method.
        """
        arrays, header = read_arrays(path)
        schema = str(header.get("schema"))
        if schema not in SCHEMAS:
            raise InputError(path, "schema", f"is {schema[:60]!r}, but one of {', '.join(SCHEMAS)} is needed")
        for name, value in cls._header(case, regime).items():
            if header.get(name) != value:
                raise InputError(path, name, f"is {str(header.get(name))[:60]!r}, but {value!r} is needed")
        horizon, training = header.get("horizon_s"), header.get("training")
        finite = isinstance(horizon, (int, float)) and 0 < horizon < float("inf")
        if horizon is None or not finite or not isinstance(training, dict):
            raise InputError(path, "horizon_s, training", "missing or mistyped")
        try:
            shapes = cls.shapes(case, training)
        except ValueError as error:
            raise InputError(path, "training", str(error)) from None
        for name in shapes.keys() | arrays.keys():
            if name not in arrays or arrays[name].shape != shapes.get(name):
                raise InputError(path, name, "is missing, unknown or has the wrong shape")
        weights = {name: arrays[name].astype(np.float32) for name in shapes}
        return cls(Scope(case, regime, float(horizon)), weights, training, schema)

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


def weights_of(network: nn.Module) -> Weights:
    """The weights and buffers of a network in torch, copied."""
    return {name: value.detach().cpu().numpy().copy() for name, value in network.state_dict().items()}


def as_solver(policy: TrainedPolicy, answer: Callable[[Instance], Array], iterations: int = 0) -> Solver:
    """Return a policy as a method; see `answered`."""
    solve = functools.partial(answered, policy, answer, iterations)
    warm_up(policy.scope, solve)
    return solve


def answered(
    policy: TrainedPolicy, answer: Callable[[Instance], Array], iterations: int, instance: Instance
) -> Solution:
    """Answer an instance by powers at the policy's knots; `solve_s` is all from the one to the others."""
    started = time.perf_counter()
    policy.scope.check([instance])
    schedule = Schedule(policy.knots, answer(instance))
    spent = time.perf_counter() - started
    return Solution(Status.POLICY, schedule, iterations or None, solve_s=spent, solver_version=SOLVER_VERSION)


def warm_up(scope: Scope, solver: Solver) -> None:
    """Pay what the first answer costs (compilation, libraries, tables), by a draw of policy training."""
    instance = sample_instance(scope.case, POLICY_SEED, 0, servable)
    solver(instance.model_copy(update={"horizon_s": scope.horizon_s}))
