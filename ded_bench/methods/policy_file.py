"""Policy files: weights and a JSON header in safetensors, and their names in a results folder.

Who answers reads weights as arrays; torch is for training alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.folder import ResultsFolder

if TYPE_CHECKING:
    from torch import nn

SCHEMA = "ded-bench/policy/1"
#: The surrogate on which policies train unless told otherwise; the names of their files do not say it.
DEFAULT_MODEL = "koopman"
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


def write_policy(path: Path, method: str, scope: Scope, weights: Weights, training: dict[str, Any]) -> None:
    """Write the weights and buffers of a network, with a header."""
    header = {
        "schema": SCHEMA,
        "method": method,
        "case": scope.case.id,
        "case_fingerprint": scope.case.fingerprint,
        "regime": scope.regime,
        "horizon_s": scope.horizon_s,
        "training": training,
    }
    write_arrays(path, weights, header)


def read_policy(
    path: str | Path, method: str, case: Case, regime: str
) -> tuple[dict[str, np.ndarray], Scope, dict[str, Any]]:
    """Read weights, scope and training facts of a policy for a case and regime.

    Raises:
        InputError: the file is wrong, or the policy is for another case, its limits changed, or for
            another regime or method.
    """
    arrays, header = read_arrays(path)
    wanted = {
        "schema": SCHEMA,
        "method": method,
        "case": case.id,
        "case_fingerprint": case.fingerprint,
        "regime": regime,
    }
    for name, value in wanted.items():
        if header.get(name) != value:
            raise InputError(path, name, f"is {str(header.get(name))[:60]!r}, but {value!r} is needed")
    horizon, training = header.get("horizon_s"), header.get("training")
    finite = isinstance(horizon, (int, float)) and 0 < horizon < float("inf")
    if horizon is None or not finite or not isinstance(training, dict):
        raise InputError(path, "horizon_s, training", "missing or mistyped")
    return arrays, Scope(case, regime, float(horizon)), training


def checked_weights(
    arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], path: str | Path
) -> Weights:
    """Arrays as the weights of a network with exactly these names and shapes; InputError otherwise."""
    for name in shapes.keys() | arrays.keys():
        if name not in arrays or arrays[name].shape != shapes.get(name):
            raise InputError(path, name, "is missing, unknown or has the wrong shape")
    return {name: arrays[name].astype(np.float32) for name in shapes}


def weights_of(network: nn.Module) -> Weights:
    """The weights and buffers of a network in torch, copied."""
    return {name: value.detach().cpu().numpy().copy() for name, value in network.state_dict().items()}


def weights_fingerprint(weights: Weights) -> str:
    """Twelve hex digits that change when any weight does."""
    return hashlib.sha256(b"".join(value.tobytes() for value in weights.values())).hexdigest()[:12]


def policy_file(results: Path, method: str, regime: str, model: str = "") -> Path:
    """Where a results folder keeps a policy: `<method>-<regime>`, and the model unless it is the default."""
    suffix = "" if model in ("", DEFAULT_MODEL) else f"-{Path(model).stem}"
    return ResultsFolder(results).policy(f"{method}-{regime}{suffix}")


def find_policy_file(method: str, case: Case, regime: str, settings: Settings) -> Path:
    """Return the policy file given in the settings, else the first one in the folders to search.

    Raises:
        InputError: there is none; names the command that trains one.
    """
    if settings.policy:
        return settings.policy
    for folder in settings.search:
        path = policy_file(folder, method, regime, settings.model)
        if path.is_file():
            return path
    command = f"ded-bench train-dpc --method {method} --regime {regime} --case {case.id}"
    command += "" if settings.model in ("", DEFAULT_MODEL) else f" --model {settings.model}"
    raise InputError("--policy", "", f"no {method} policy for {regime} yet; run `{command}`")
