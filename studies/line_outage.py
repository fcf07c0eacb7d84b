"""A line trips: what is a policy worth on a grid that it was not trained on?

    python studies/line_outage.py --out results/line-outage

One of the two lines 7-8 of two-area goes. Weights of the reference run, after three more epochs on the grid
as it is, and after three epochs without the line answer draws of both grids. Some minutes on one core;
weights that are there are not made again.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pandas as pd

from ded_bench import Case, Settings, score, solve
from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.methods.training_record import find_policy_file
from ded_bench.plants.plant import servable
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.problem.sampling import sample_instance
from ded_bench.results.folder import search_folders

REGIME, SEED, CASE, LINE = "TO", 20241, "two-area", 10


def without_line(folder: Path) -> Case:
    """The case without one of its lines, in a folder of its own, with instances to train on."""
    if not (folder / "MANIFEST.json").exists():
        document = json.loads((SHIPPED_CASES / CASE / "case.json").read_text())
        document["id"] = f"{CASE}-outage"
        del document["lines"][LINE]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "case.json").write_text(json.dumps(document))
        run("instances", "--case", folder, "--count", 500, "--test", 100)
    return Case.load(folder)


def run(*words: object) -> None:
    """A command of ded-bench."""
    subprocess.run([sys.executable, "-m", "ded_bench", *map(str, words)], check=True)


def trained_on(case: str | Path, start: Path, epochs: int, out: Path) -> Path:
    """File of weights after more epochs on a grid."""
    if not out.exists():
        choice = ("--case", case, "--regime", REGIME, "--start", start, "--epochs", epochs, "--out", out)
        run("train-dpc", "--method", "ded-admm", *choice, "--results", out.parent)
    return out


def moved(path: Path, own: Case, grid: Case, folder: Path) -> Path:
    """The same weights in a file for another grid."""
    policy = AdmmPolicy.load(path, own, REGIME)
    out = folder / grid.id / f"{path.parent.name}.safetensors"
    dataclasses.replace(policy, scope=dataclasses.replace(policy.scope, case=grid)).save(out)
    return out


def judged(grid: Case, weights: dict[str, Path], draws: int) -> list[dict]:
    """A row for each policy and draw of a grid that can be served; the first is refined, too."""
    answers = [(name, Settings(policy=path)) for name, path in weights.items()]
    first, path = next(iter(weights.items()))
    answers.append((f"{first}, refined", Settings("iterations=80", policy=path)))
    rows = []
    for instance in (sample_instance(grid, SEED, k) for k in range(draws)):
        best = solve(instance, "ded-slp", REGIME, case=grid) if servable(grid, instance) else None
        if best is None or best.schedule is None:
            continue
        least = score(instance, best.schedule, REGIME, case=grid).objective
        for name, settings in answers:
            answer = solve(instance, "ded-admm", REGIME, case=grid, settings=settings)
            verdict = score(instance, answer.schedule, REGIME, case=grid)
            gap = 100.0 * (verdict.objective / least - 1.0)
            found = {"weights": name, "grid": grid.id, "gap_percent": gap, "feasible": verdict.feasible}
            rows.append(found | {"violation_mhz": 1e3 * verdict.freq_violation_hz})
    return rows


def main() -> None:
    """Print the table, and write it to the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("results/line-outage"))
    chosen = parser.parse_args()
    intact, outage = Case.load(CASE), without_line(chosen.out / "grid")
    known = find_policy_file("ded-admm", intact, REGIME, Settings(search=search_folders(intact)))
    files = {"of the reference run": (intact, known)}
    if chosen.epochs:
        more = trained_on(CASE, known, chosen.epochs, chosen.out / "intact" / "weights.safetensors")
        without = chosen.out / "outage" / "weights.safetensors"
        less = trained_on(chosen.out / "grid", known, chosen.epochs, without)
        files |= {"more epochs, intact": (intact, more), "more epochs without it": (outage, less)}
    rows = []
    for grid in (intact, outage):
        weights = {
            name: path if own is grid else moved(path, own, grid, chosen.out)
            for name, (own, path) in files.items()
        }
        rows += judged(grid, weights, chosen.draws)
    grouped = pd.DataFrame(rows).groupby(["weights", "grid"], sort=False)
    table = grouped.agg(
        n=("feasible", "size"),
        gap_percent=("gap_percent", "mean"),
        violation_mhz=("violation_mhz", "mean"),
        largest_mhz=("violation_mhz", "max"),
        feasible=("feasible", "sum"),
    )
    table.to_csv(chosen.out / "table.csv")
    print(table.to_string(float_format="%.4f"))


if __name__ == "__main__":
    main()
