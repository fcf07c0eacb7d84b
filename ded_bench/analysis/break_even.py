"""What a trained policy is worth: after how many schedules has its training paid, beside linear programs?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd

from ded_bench.analysis.summary import summary

#: Methods that need no training; of the settings of each, the first with rows and a time.
RIVALS = {"ded-ko-knots": ("default-trajectory", "default"), "ded-slp": ("default",)}
#: Schedules of a second comparison, training included.
MANY = 1000
#: What is compared, by the name of its columns.
COMPARED = ("gap_percent_mean", "freq_violation_hz_mean", "correct_rate", "solve_s")
COLUMNS = (
    *("regime", "title", "training_s", "rival"),
    *(name for value in (*COMPARED, "many_s") for name in (value, f"rival_{value}")),
    "paid_after",
)


def payoff(rows: pd.DataFrame, timing: pd.DataFrame, training_s: Mapping[str, float]) -> pd.DataFrame:
    """One line per regime, policy with default settings, and rival.

    Args:
        rows: judged rows of one case with their gaps (see `summary.gaps`).
        timing: see `timing.timing_summary`.
        training_s: how long each policy was trained, s, by the name of its file.

    Returns:
        What COLUMNS name: gap (%), violation (Hz), share of feasible schedules and time (s) of both;
        `many_s`, time of MANY schedules one after another, training included; `paid_after`, schedules after
        which training and answers took less time than the rival's answers, infinite if they never do.
    """
    policies = rows[rows["policy"].fillna("").ne("") & rows["settings"].eq("default")]
    files = policies.groupby(["regime", "method"])["policy"].first().str.split("@").str[0]
    seconds = timing.set_index(["regime", "method", "settings"])["solve_s"]
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for line in summary(rows).to_dict("records"):
        key = (str(line["regime"]), str(line["method"]), str(line["settings"]))
        found[key] = {str(name): value for name, value in line.items()}
        found[key]["solve_s"] = float(seconds.get(key, math.nan))
    lines = [
        _line(found[regime, method, "default"], rival, training_s[f"{file}-{regime}"])
        for (regime, method), file in zip(files.index.tolist(), files, strict=True)
        for rival in _rivals(found, regime)
        if f"{file}-{regime}" in training_s
    ]
    return pd.DataFrame(lines, columns=list(COLUMNS))


def _rivals(found: Mapping[tuple[str, str, str], dict[str, Any]], regime: str) -> list[dict[str, Any]]:
    """Those with rows and a time."""
    rivals = []
    for method, settings in RIVALS.items():
        known = [found[regime, method, name] for name in settings if (regime, method, name) in found]
        rivals += [line for line in known if line["solve_s"] > 0][:1]
    return rivals


def _line(policy: dict[str, Any], rival: dict[str, Any], training_s: float) -> dict[str, Any]:
    return {
        "regime": policy["regime"],
        "title": policy["title"],
        "training_s": training_s,
        "rival": rival["title"],
        "many_s": training_s + MANY * policy["solve_s"],
        "rival_many_s": MANY * rival["solve_s"],
        "paid_after": _schedules(training_s, rival["solve_s"] - policy["solve_s"]),
        **{name: policy[name] for name in COMPARED},
        **{f"rival_{name}": rival[name] for name in COMPARED},
    }


def _schedules(training_s: float, saved_s: float) -> float:
    """After how many schedules what each saves adds up to the training; missing if a time is."""
    if math.isnan(saved_s):
        return math.nan
    return float(math.ceil(training_s / saved_s)) if saved_s > 0 else math.inf
