"""The suite in a minute: `python examples/tour.py` writes a table and a figure to `results/tour`."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ded_bench import Case, load_instances, score, simulate, solve

OUT = Path("results/tour")
REGIME = "TO"  # the tight bound on frequency, where dynamics bind
METHODS = ("ed", "ded-ko-knots", "ded-slp", "ded-dpc")

# %% What is asked: instances, each with costs, load ramps and an initial state
case = Case.load("9bus")
instances = load_instances("9bus", split="test", limit=3)
asked = pd.json_normalize([instance.model_dump() for instance in instances])
print(asked[["id", "cost.2", "load.5.rate", "initial.power.2"]].to_string(index=False))

# %% What methods answer, and what the scorer says to it: always by simulation of the true system
rows, schedules = [], {}
for instance in instances:
    for method in METHODS:
        answer = solve(instance, method, REGIME)
        schedules[instance.id, method] = answer.schedule
        verdict = score(instance, answer.schedule, REGIME)
        rows.append(
            {
                "instance": instance.id,
                "method": method,
                "claimed": str(answer.status),
                "solve_s": answer.solve_s,
                "objective": verdict.objective,
                "violation_hz": verdict.freq_violation_hz,
                "feasible": verdict.feasible,
            }
        )
table = pd.DataFrame(rows)
OUT.mkdir(parents=True, exist_ok=True)
table.to_csv(OUT / "table.csv", index=False)
print(table.to_string(index=False, float_format="{:.6g}".format))

# %% Static dispatch is cheap because it breaks the bound; the others pay for keeping it
best = table[table["feasible"]].groupby("instance")["objective"].min()
gap = 100 * (table["objective"] / table["instance"].map(best) - 1)
print(table.assign(gap_percent=gap).groupby("method")[["gap_percent", "violation_hz"]].mean().to_string())

# %% What the frequencies do
instance = instances[0]
figure = Figure(figsize=(8, 5), layout="constrained")
above, below = figure.subplots(2, sharex=True)
for method in METHODS:
    frame = simulate(instance, schedules[instance.id, method]).to_frame()
    first = case.generators[0]
    above.plot(frame["t"], frame[f"P_{first}"], label=method)
    below.plot(frame["t"], 1e3 * frame[f"omega_{first}"] / (2 * np.pi))
bound = 1e3 * case.omega_bound(REGIME) / (2 * np.pi)
below.axhspan(-bound, bound, alpha=0.1)
above.set_ylabel(f"power of {case.generators[0]} (pu)")
above.legend(ncols=len(METHODS))
below.set(xlabel="time (s)", ylabel="frequency deviation (mHz)")
figure.savefig(OUT / "schedules.png")
print(f"wrote {OUT / 'table.csv'} and {OUT / 'schedules.png'}", file=sys.stderr)
