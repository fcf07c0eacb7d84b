"""A line trips: what is a policy worth on a grid that it was not trained on?

    python examples/line_outage.py --out results/line-outage

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
from ded_bench.methods.admm.admm_policy import find_policy
from ded_bench.methods.admm.admm_refined import Refiner
from ded_bench.methods.policy_file import find_policy_file
from ded_bench.plants.lossless.network import PowerFlowError
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.problem.sampling import sample_instance
from ded_bench.results.reference_run import search_folders

REGIME, SEED = "TO", 20241


def without_line(case: str, line: int, folder: Path) -> Case:
    """A shipped case without one of its lines, in a folder of its own, with instances to train on."""
    if not (folder / "MANIFEST.json").exists():
        document = json.loads((SHIPPED_CASES / case / "case.json").read_text())
        document["id"] = f"{case}-outage"
        del document["lines"][line]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "case.json").write_text(json.dumps(document))
        run("instances", "--case", folder, "--count", 500, "--test", 100)
    return Case.load(folder)


def run(*words: object) -> None:
    """A command of ded-bench."""
    subprocess.run([sys.executable, "-m", "ded_bench", *map(str, words)], check=True)


def trained_on(case: str | Path, start: Path, epochs: int, results: Path) -> Path:
    """File of weights after more epochs on a grid."""
    out = results / "weights.safetensors"
    if not out.exists():
        choice = ("--case", case, "--regime", REGIME, "--start", start, "--epochs", epochs, "--out", out)
        run("train-dpc", "--method", "ded-dpc-shared", "--model", "linear", *choice, "--results", results)
    return out


def policies_on(grid: Case, files: dict[str, tuple[Case, Path]]) -> dict:
    """Policies by name, whose weights are asked about a grid; the last refines those named first."""
    found = {}
    for name, (own, path) in files.items():
        known = find_policy(own, REGIME, Settings(policy=path))
        found[name] = dataclasses.replace(known, scope=dataclasses.replace(known.scope, case=grid))
    first = next(iter(found.values()))
    return found | {f"{next(iter(found))}, refined": Refiner.of(first, learned=True)}


def judged(grid: Case, policies: dict, draws: int) -> list[dict]:
    """A row for each policy and draw of a grid that can be served."""
    rows = []
    for k in range(draws):
        try:
            instance = sample_instance(grid, SEED, k)
            best = solve(instance, "ded-slp", REGIME, case=grid)
        except PowerFlowError:
            continue
        if best.schedule is None:
            continue
        least = score(instance, best.schedule, REGIME, case=grid).objective
        for name, policy in policies.items():
            answer = policy(instance)
            schedule = answer[0] if isinstance(answer, list) else answer
            verdict = score(instance, schedule, REGIME, case=grid)
            rows.append(
                {
                    "weights": name,
                    "grid": grid.id,
                    "gap_percent": 100.0 * (verdict.objective / least - 1.0),
                    "violation_mhz": 1e3 * verdict.freq_violation_hz,
                    "feasible": verdict.feasible,
                }
            )
    return rows


def main(words: list[str] | None = None) -> None:
    """Print the table, and write it to the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", default="two-area")
    parser.add_argument("--line", type=int, default=10, help="its place in the case's list of lines")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("results/line-outage"))
    chosen = parser.parse_args(words)
    intact = Case.load(chosen.case)
    outage = without_line(chosen.case, chosen.line, chosen.out / "grid")
    known = find_policy_file("ded-dpc-shared", intact, REGIME, Settings(search=search_folders(intact)))
    files = {"reference": (intact, known)}
    if chosen.epochs:
        for name, grid, place in ("intact", intact, chosen.case), ("outage", outage, chosen.out / "grid"):
            path = trained_on(place, known, chosen.epochs, chosen.out / name)
            files[f"more epochs, {name}"] = grid, path
    rows = [row for grid in (intact, outage) for row in judged(grid, policies_on(grid, files), chosen.draws)]
    table = (
        pd.DataFrame(rows)
        .groupby(["weights", "grid"], sort=False)
        .agg(
            n=("feasible", "size"),
            gap_percent=("gap_percent", "mean"),
            violation_mhz=("violation_mhz", "mean"),
            largest_mhz=("violation_mhz", "max"),
            feasible=("feasible", "sum"),
        )
    )
    table.to_csv(chosen.out / "table.csv")
    print(table.to_string(float_format="%.4f"))


if __name__ == "__main__":
    main()
