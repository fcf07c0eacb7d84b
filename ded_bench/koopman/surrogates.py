"""The surrogates by name, and where trained ones lie."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ded_bench.files.errors import InputError
from ded_bench.files.results_folder import ResultsFolder
from ded_bench.koopman.linear import nominal_model, single_sample
from ded_bench.koopman.model import Koopman
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import REPOSITORY, Case

#: Models that `ded-bench train-ko` identifies.
TRAINED = ("koopman", "koopman-paper")
#: The linearisation along a simulated trajectory, on the lossless network and on the full AC network.
TRAJECTORY, TRAJECTORY_AC = "trajectory", "trajectory-ac"
#: All models by name; those not trained follow from the case, from `koopman`, or from each instance.
MODELS = (*TRAINED, "koopman-single", "linear", TRAJECTORY, TRAJECTORY_AC)


@dataclass(frozen=True)
class AlongTrajectory:
    """The surrogate that is made anew for each instance: nothing of it is trained (see `instance_model`)."""

    case: Case
    data: AcCase | None = None  # simulate on the AC network

    @property
    def kind(self) -> str:
        """Its name among the models."""
        return TRAJECTORY if self.data is None else TRAJECTORY_AC

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with the case and its AC data."""
        text = f"{self.kind}|{self.case.fingerprint}"
        text += "" if self.data is None else f"|{self.data.fingerprint}"
        return hashlib.sha256(text.encode()).hexdigest()[:12]


#: A lifted model has one K for all instances and times; the other kind is made for each instance.
Surrogate = Koopman | AlongTrajectory


def default_results(case: Case) -> Path:
    """Where results of a case lie unless told otherwise, below the working directory."""
    return Path("results") / case.id


def search_folders(case: Case, *first: Path) -> tuple[Path, ...]:
    """Where trained models and policies are looked for: `first`, default results, reference run."""
    return (*first, default_results(case), REPOSITORY / "results" / f"{case.id}-reference")


def model_file(results: Path, kind: str) -> Path:
    """Where a results folder keeps a model."""
    return ResultsFolder(results).model(kind)


def find_surrogate(case: Case, name: str, search: Sequence[Path]) -> Surrogate:
    """Return a surrogate by its kind, from the first folder that has it, or by its file's path.

    Raises:
        InputError: there is no such model yet (names the command that makes it), or its file is wrong.
    """
    if name in (TRAJECTORY, TRAJECTORY_AC):
        return AlongTrajectory(case, AcCase.of(case) if name == TRAJECTORY_AC else None)
    return find_model(case, name, search)


def find_model(case: Case, name: str, search: Sequence[Path]) -> Koopman:
    """Return a lifted model by its kind, from the first folder that has it, or by its file's path.

    Raises:
        InputError: there is no such model yet (names the command that makes it), its file is wrong, or the
            surrogate of this name is made for each instance.
    """
    if name in (TRAJECTORY, TRAJECTORY_AC):
        raise InputError("--model", name, "has no K for all instances; `ded-ko` and `ded-ko-knots` know it")
    path = find_model_file(case, name, search)
    if path is None:
        return nominal_model(case)
    model = Koopman.load(path, case)
    return single_sample(model, case) if name == "koopman-single" else model


def find_model_file(case: Case, name: str, search: Sequence[Path]) -> Path | None:
    """The file that a model is read or derived from; None if it follows from the case.

    Raises:
        InputError: there is no such model yet (names the command that makes it).
    """
    if name in ("linear", TRAJECTORY, TRAJECTORY_AC):
        return None
    kind = "koopman" if name == "koopman-single" else name
    if kind in TRAINED:
        for folder in search:
            if model_file(folder, kind).is_file():
                return model_file(folder, kind)
        raise InputError("--model", kind, f"not identified yet; run `ded-bench train-ko --case {case.id}`")
    if Path(name).is_file():
        return Path(name)
    raise InputError("--model", name, f"no such file and no such model (known: {', '.join(MODELS)})")
