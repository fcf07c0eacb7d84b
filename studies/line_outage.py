"""A line trips: what is a policy worth on a grid that it was not trained on?

    python studies/line_outage.py --out results/line-outage

One of the two lines 7-8 of two-area goes. Weights of the reference run answer draws of both grids, with and
without refinement. A minute on one core.
"""

import argparse
import dataclasses
import json
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


def without_line(path: Path) -> Case:
    """The case without one of its lines, written to a file."""
    document = json.loads((SHIPPED_CASES / CASE / "case.json").read_text())
    document["id"] = f"{CASE}-outage"
    del document["lines"][LINE]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return Case.load(path)


def moved(path: Path, own: Case, grid: Case, folder: Path) -> Path:
    """The same weights in a file for another grid."""
    policy = AdmmPolicy.load(path, own, REGIME)
    out = folder / "moved.safetensors"
    dataclasses.replace(policy, scope=dataclasses.replace(policy.scope, case=grid)).save(out)
    return out


def judged(grid: Case, policy: Path, draws: int) -> list[dict]:
    """Two rows for each draw of a grid that can be served: the policy's answer, and the same refined."""
    answers = [("as trained", Settings(policy=policy)), ("refined", Settings("iterations=80", policy=policy))]
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
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("results/line-outage"))
    chosen = parser.parse_args()
    intact, outage = Case.load(CASE), without_line(chosen.out / "case.json")
    known = find_policy_file("ded-admm", intact, REGIME, Settings(search=search_folders(intact)))
    rows = judged(intact, known, chosen.draws)
    rows += judged(outage, moved(known, intact, outage, chosen.out), chosen.draws)
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
