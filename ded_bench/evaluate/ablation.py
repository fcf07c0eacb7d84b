"""What models and training contribute: tables that compare variants of one method with each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.evaluate.summary import (
    GROUP,
    START,
    STUDY,
    gaps,
    is_study,
    summary,
    title,
    validation_rows,
)
from ded_bench.files.arrays import read_arrays
from ded_bench.files.errors import InputError
from ded_bench.koopman.surrogates import MODELS
from ded_bench.methods.dpc.variants import SETTINGS
from ded_bench.methods.policy_file import policy_file
from ded_bench.methods.solution import DEFAULT_MODEL

#: Full DED from its cold start, which other starting points are compared with.
STARTED = ("ded", "default")
#: What short trainings are measured against: full DED is not solved on validation instances.
ABLATION_REFERENCE = ("ded-ko-knots", "default")
#: Optima whose objectives differ by less are the same; relative. IPOPT's tolerance leaves 1e-8.
SAME = 1e-6


def split_slug(slug: str) -> tuple[str, str]:
    """A row's settings as (name of the settings, Koopman model)."""
    for model in MODELS:
        if model != DEFAULT_MODEL and slug.endswith(f"-{model}"):
            return slug.removesuffix(f"-{model}"), model
    return slug, DEFAULT_MODEL


def main_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows of the paper's tables: those on our Koopman model wherever a method has rows with it."""
    parts = [split_slug(slug) for slug in frame["settings"]]
    names, models = [name for name, _ in parts], [model for _, model in parts]
    named = frame.assign(_name=names, _ours=[model == DEFAULT_MODEL for model in models])
    best = named.groupby(["method", "_name"])["_ours"].transform("any")
    return frame[(named["_ours"] | ~best).to_numpy()]


def model_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a summary: every method and settings that were run on more than one Koopman model."""
    table = rows.copy()
    table[["name", "model"]] = [split_slug(slug) for slug in table["settings"]] or np.empty((0, 2))
    several = table.groupby(["method", "name"])["model"].transform("nunique") > 1
    named = [title(method, name) for method, name in zip(table["method"], table["name"], strict=True)]
    order = [MODELS.index(model) for model in table["model"]]
    return (
        table.assign(_order=order, title=named)[several]
        .sort_values(["regime", "method", "name", "_order"], kind="stable", ignore_index=True)
        .drop(columns="_order")
    )


def ablation_table(frame: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """The short trainings side by side: what differs, gaps, violations, cost of the training.

    Judged on the rows of validation instances alone; gaps are to ABLATION_REFERENCE there.
    """
    chosen = validation_rows(frame)
    method, settings = ABLATION_REFERENCE
    against = chosen[(chosen["method"] == method) & (chosen["settings"] == settings)]
    overview = summary(gaps(chosen, against.set_index(["instance", "regime"])["objective"]))
    rows = []
    for row in overview[overview["settings"].map(is_study).astype(bool)].to_dict("records"):
        name, model = split_slug(str(row["settings"]))
        path = policy_file(folder, str(row["method"]), str(row["regime"]), model, name)
        rows.append(row | {"change": _change(str(row["method"]), name, model)} | _facts(path))
    columns = [*GROUP, "change", *SHOWN, *FACTS]
    return pd.DataFrame(rows, columns=columns).sort_values(
        ["regime", "gap_percent_mean"], kind="stable", ignore_index=True
    )


def starts_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Full DED from other starting points against its cold start: are the optima that IPOPT claims the same?

    Differences are of the solver's objectives, which the scorer's errors do not blur.
    """
    rows = frame[frame["method"] == STARTED[0]].dropna(subset=["solver_objective"])
    cold = rows[rows["settings"] == STARTED[1]]
    table = []
    others = rows[rows["settings"].str.startswith(START)]
    for (regime, settings), group in others.groupby(["regime", "settings"], sort=False):
        pairs = group.merge(cold, on=["regime", "instance"], suffixes=("", "_cold"))
        change = pairs["solver_objective"] / pairs["solver_objective_cold"] - 1.0
        table.append(
            {
                "regime": regime,
                "start": str(settings).removeprefix(START),
                "n": len(pairs),
                "same": int((change.abs() <= SAME).sum()),
                "lowest_percent": 100.0 * change.min(),
                "highest_percent": 100.0 * change.max(),
                "iterations": pairs["iterations"].median(),
                "iterations_cold": pairs["iterations_cold"].median(),
            }
        )
    return pd.DataFrame(table, columns=STARTS).sort_values("regime", kind="stable", ignore_index=True)


STARTS = (
    *("regime", "start", "n", "same", "lowest_percent", "highest_percent"),
    *("iterations", "iterations_cold"),
)
SHOWN = (
    "n",
    *(f"gap_percent_{part}" for part in ("mean", "p95", "max")),
    *(f"freq_violation_hz_{part}" for part in ("mean", "max")),
)
FACTS = ("seconds", "epochs", "steps", "instances", "parameters")


def training_table(folder: Path, columns: Sequence[str]) -> pd.DataFrame:
    """How each policy of a folder was trained, from the headers of their files."""
    rows = [
        {"policy": path.stem} | _facts(path) for path in sorted((folder / "policies").glob("*.safetensors"))
    ]
    return pd.DataFrame(rows, columns=["policy", *columns, "problem"])


def _facts(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {"problem": "no file"}
    try:
        _, header = read_arrays(path)
    except InputError as error:
        return {"problem": str(error)}
    facts = header.get("training")
    return {"problem": ""} | (facts if isinstance(facts, dict) else {})


def _change(method: str, name: str, model: str) -> str:
    """What a study's settings change, in words."""
    known = SETTINGS if method == "ded-dpc" else {}
    base, own = known.get(STUDY, {}), known.get(name, {})
    changed = [f"{key} = {value}" for key, value in own.items() if base.get(key) != value]
    changed += [] if model == DEFAULT_MODEL else [f"model = {model}"]
    return ", ".join(changed) or "nothing"
