"""What was trained, or derived from a case, and shapes a method's answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


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
