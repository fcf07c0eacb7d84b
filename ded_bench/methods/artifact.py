"""What was trained, or derived from a case, and shapes a method's answers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.surrogates.find import find_model_file, find_surrogate


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


def model_artifact(case: Case, settings: Settings, default: str = "koopman") -> Artifact:
    """The surrogate that the settings name, else the method's own.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    name = settings.model or default
    model = find_surrogate(case, name, settings.search)
    path = find_model_file(case, name, settings.search)
    return Artifact("model", model.kind, model.fingerprint, path)


def named(artifacts: Iterable[Artifact], kind: str) -> str:
    """The models, or the policies, that shaped an answer, as rows say it: `name@fingerprint`, joined by +."""
    return "+".join(f"{a.name}@{a.fingerprint}" for a in artifacts if a.kind == kind)
