"""Where results folders keep policies."""

from __future__ import annotations

from pathlib import Path

from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder

#: The surrogate on which policies train unless told otherwise; the names of their files do not say it.
DEFAULT_MODEL = "koopman"


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
