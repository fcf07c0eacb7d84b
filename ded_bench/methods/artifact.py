"""What was trained, or derived from a case, and shapes a method's answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ded_bench.koopman.surrogates import find_model_file, find_surrogate
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case


@dataclass(frozen=True)
class Artifact:
    """A model or policy that answers depend on.

    Attributes:
        kind: a surrogate, a policy, or the code of a method that lies outside this package.
        name: the model's kind, the method of a policy, or `module:function`.
        fingerprint: changes whenever the numbers inside (or the code) do.
        path: the file it was read from; None if it follows from the case or is no file.
    """

    kind: Literal["model", "policy", "code"]
    name: str
    fingerprint: str
    path: Path | None = None


def model_artifact(case: Case, settings: Settings) -> Artifact:
    """The surrogate that the settings name.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    model = find_surrogate(case, settings.model, settings.search)
    path = find_model_file(case, settings.model, settings.search)
    return Artifact("model", model.kind, model.fingerprint, path)
