"""DED-KO on the case's knots, on swing equations identified from AC trajectories: its setting `swing-ac`.

The sequence of `ded-slp`, but along what the identified equations say: linear programs along their own
simulations, by steps within a trust region. No equation of a network is used, and no answer is simulated
on one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.koopman.identified_swing import KIND, IdentifiedSwing
from ded_bench.koopman.surrogates import model_file
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.ded_slp import SlpSolver
from ded_bench.methods.solution import DEFAULT_MODEL, Settings
from ded_bench.methods.trust_region import TrustRegionSequence
from ded_bench.problem.case import Case

#: This setting has no options.
SETTINGS: Mapping[str, Mapping[str, Any]] = {"swing-ac": {}}


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The model that `prepare` would use."""
    path = _file(case, settings)
    return (Artifact("model", KIND, IdentifiedSwing.load(path, case).fingerprint, path),)


def prepare(case: Case, regime: str, settings: Settings) -> SlpSolver:
    """Return a solver of single instances on the identified model: a file, or that of the results folders."""
    case.check_regimes([regime])
    model = IdentifiedSwing.load(_file(case, settings), case)
    sequence = functools.partial(TrustRegionSequence, dynamics=model)
    return SlpSolver(case, regime, settings.time_limit_s, sequence=sequence, **SETTINGS[settings.name])


def _file(case: Case, settings: Settings) -> Path:
    """Where the model lies.

    Raises:
        InputError: nowhere (names the command that makes it).
    """
    if settings.model != DEFAULT_MODEL:
        return Path(settings.model)
    for folder in settings.search:
        if model_file(folder, KIND).is_file():
            return model_file(folder, KIND)
    command = f"ded-bench train-ko --case {case.id} --truth ac --kind swing"
    raise InputError(
        "--settings", settings.name, f"needs a model that is not identified yet; run `{command}`"
    )
