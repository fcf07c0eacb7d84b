"""After how many schedules has a policy's training paid, beside linear programs that need none?

python studies/break_even.py results/*-reference
"""

import math
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench.analysis.summary import GROUP, records, summary
from ded_bench.methods.options import DEFAULT
from ded_bench.report.overview import read_grid
from ded_bench.report.sources import trainings

#: Methods that need no training, with the surrogates of which the first with rows and a time counts.
RIVALS = {"ded-ko-knots": ("trajectory", "koopman"), "ded-slp": ("",)}
#: Schedules of a second comparison, training included.
MANY = 1000
#: What is compared, by the name of its columns.
COMPARED = ("gap_percent_mean", "freq_violation_hz_mean", "correct_rate", "solve_s")
COLUMNS = (
    *("regime", "title", "training_s", "rival"),
    *(name for value in (*COMPARED, "many_s") for name in (value, f"rival_{value}")),
    "paid_after",
)


def break_even(rows: pd.DataFrame, timing: pd.DataFrame, training_s: Mapping[str, float]) -> pd.DataFrame:
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
    lines = summary(rows)
    seconds = timing.set_index(GROUP)["solve_s"]
    lines["solve_s"] = [seconds.get(key, math.nan) for key in lines[GROUP].itertuples(index=False, name=None)]
    lines["many_s"] = MANY * lines["solve_s"]
    lines = lines[lines["settings"] == DEFAULT]
    policies = rows[rows["policy"] != ""].groupby(["regime", "method"])["policy"].first()
    found = []
    for policy in records(lines):
        name = policies.get((policy["regime"], policy["method"]), "")
        cost = training_s.get(f"{name}-{policy['regime']}", math.nan)
        if math.isnan(cost):
            continue
        here = lines[(lines["regime"] == policy["regime"]) & (lines["solve_s"] > 0)]
        for method, models in RIVALS.items():
            known = here[here["method"] == method].set_index("model").reindex(models).dropna(subset=["title"])
            for rival in records(known[:1]):
                compared = {f"rival_{name}": rival[name] for name in (*COMPARED, "many_s")}
                saved_s = rival["solve_s"] - policy["solve_s"]
                paid = (
                    math.ceil(cost / saved_s) if saved_s > 0 else math.nan if math.isnan(saved_s) else np.inf
                )
                own = policy | {"many_s": cost + policy["many_s"], "training_s": cost}
                found.append(own | compared | {"rival": rival["title"], "paid_after": paid})
    return pd.DataFrame(found, columns=list(COLUMNS))


def main() -> None:
    """Print a table for each results folder."""
    for folder in map(Path, sys.argv[1:]):
        grid = read_grid(folder)
        seconds = (
            trainings(sorted(grid.results.paths.policies.glob("*.safetensors")))
            .set_index("name")["seconds"]
            .dropna()
        )
        cost = {str(name): float(value) for name, value in seconds.items()}
        print(f"\n{grid.case.id}\n{break_even(grid.judged, grid.timing, cost).to_string(index=False)}")


if __name__ == "__main__":
    main()
