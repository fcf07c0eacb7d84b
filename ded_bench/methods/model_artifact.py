"""The surrogate that shapes a method's answers."""

from __future__ import annotations

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.surrogates.find import find_model_file, find_surrogate


def model_artifact(case: Case, settings: Settings) -> Artifact:
    """The surrogate that the settings name.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    model = find_surrogate(case, settings.model, settings.search)
    path = find_model_file(case, settings.model, settings.search)
    return Artifact("model", model.kind, model.fingerprint, path)
