"""Where trained models lie and which names they answer to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ded_bench.koopman.model import Koopman
from ded_bench.koopman.physics import linear_model
from ded_bench.problem.case import Case
from ded_bench.problem.errors import InputError

#: Models that `ded-bench train-ko` identifies, beside `linear`, which needs no training.
TRAINED = ("koopman", "koopman-paper")


def model_file(results: Path, kind: str) -> Path:
    """Where a results folder keeps a model."""
    return results / "koopman" / f"{kind}.safetensors"


def find_model(case: Case, name: str, search: Sequence[Path]) -> Koopman:
    """Return a model by its kind, from the first folder that has it, or by its file's path.

    Raises:
        InputError: there is no such model yet (names the command that makes it), or its file is wrong.
    """
    if name == "linear":
        return linear_model(case)
    if name in TRAINED:
        for folder in search:
            if model_file(folder, name).is_file():
                return Koopman.load(model_file(folder, name), case)
        raise InputError("--model", name, f"not identified yet; run `ded-bench train-ko --case {case.id}`")
    if Path(name).is_file():
        return Koopman.load(name, case)
    raise InputError("--model", name, f"no such file and no such model (known: linear, {', '.join(TRAINED)})")
