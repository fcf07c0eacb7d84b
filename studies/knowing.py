"""What knowing the plant buys: schedules planned on a poorer plant, judged on the true one.

Copies of an island's case are altered; `ded-slp` plans on each, and the plant of the case itself says what
its schedules do. Where an altered plant has other losses, its machines start from other powers: what the plan
changes is added to the true ones, within limits.

    python studies/knowing.py CASE REGIME COUNT
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ded_bench import Case, load_instances
from ded_bench.files.errors import InputError
from ded_bench.methods.ed import static_dispatch
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.plants.score import Score, score
from ded_bench.problem.case import case_file
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: A time constant that is none on the scale of dispatch, s; one that never ends; a droop without gain.
FAST_S, ENDLESS_S, NO_DROOP = 0.05, 1e5, 1e6
#: Damping over inertia of lossless cases, 1/s.
DAMPING = 0.3
Files = dict[str, Any]


def no_lag(files: Files) -> None:
    """Turbines deliver what governors ask for, at once."""
    for machine in files["machines"]["machines"]:
        machine["governor"] |= {"t1": FAST_S, "t2": FAST_S, "t3": FAST_S}


def no_losses(files: Files) -> None:
    """Lines without resistance."""
    for line in files["network"]["lines"]:
        line["r"] = 0.0


def constant_flux(files: Files) -> None:
    """Field and damper windings keep their flux: E' is constant, and exciters do nothing."""
    for machine in files["machines"]["machines"]:
        if machine["model"] == "GENROU":
            machine |= {"Td10": ENDLESS_S, "Tq10": ENDLESS_S}


def no_exciters(files: Files) -> None:
    """Field voltages are constant."""
    for machine in files["machines"]["machines"]:
        machine |= {"exciter": None, "pss": None}


def classical(files: Files) -> None:
    """The paper's machines: constant E' behind x'd, lossless lines, no governor's answer, no AGC."""
    no_losses(files)
    no_lag(files)
    kept = ("name", "bus", "share", "mva", "h", "xd1", "governor")
    machines = files["machines"]["machines"]
    for i, machine in enumerate(machines):
        small = {key: machine[key] for key in kept} | {"model": "GENCLS", "exciter": None, "pss": None}
        small["governor"] |= {"r": NO_DROOP}
        machines[i] = small | {"d": DAMPING * 2 * machine["h"]}
    files["case"]["plant"]["agc"] = None


#: None: nobody plans, static dispatch goes through the governors' inverse filter.
PLANTS: dict[str, Callable[[Files], None] | None] = {
    "true plant": lambda files: None,
    "static dispatch, led": None,
    "no governor lag": no_lag,
    "no losses": no_losses,
    "E' constant": constant_flux,
    "no exciters": no_exciters,
    "paper's network": classical,
}


def altered(name: str, change: Callable[[Files], None]) -> Case:
    """The case with other files."""
    source = case_file(name).parent
    files = {
        part: json.loads((source / f"{part}.json").read_text()) for part in ("case", "network", "machines")
    }
    change(files)
    with tempfile.TemporaryDirectory() as folder:
        for part, data in files.items():
            Path(folder, f"{part}.json").write_text(json.dumps(data))
        return Case.load(folder)


def plan(case: Case, true: Case, regime: str, instance: Instance) -> Schedule | None:
    """What ded-slp plans on a case's plant, from the powers of the true one; None: it finds nothing."""
    try:
        known = instance if case.fingerprint == true.fingerprint else plant_of(case).balanced(instance)
        found = get_method("ded-slp").prepare(case, regime, Settings())(known).schedule
    except (InputError, SimulationError):
        return None
    if found is None:
        return None
    p = found.p + (instance.p_initial(true) - known.p_initial(case))
    return Schedule(found.t, np.clip(p, true.p_min, true.p_max))


def main(name: str, regime: str, count: int) -> None:
    """Plan, judge, print a table."""
    true = Case.load(name)
    instances = list(load_instances(name, split="test"))[:count]
    best: dict[str, float] = {}
    columns = "plans", "followed", "mean, mHz", "swings, mHz", "excess, mHz", "over `ded-slp`, %", "feasible"
    print(f"| planned on | {' | '.join(columns)} |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for label, change in PLANTS.items():
        case = true if change is None else altered(name, change)
        scores: dict[str, Score] = {}
        planned = 0
        for instance in instances:
            schedule = (
                static_dispatch(true, instance) if change is None else plan(case, true, regime, instance)
            )
            planned += schedule is not None
            try:
                if schedule is not None:
                    scores[instance.id] = score(true, instance, schedule, regime)
            except SimulationError:
                continue
        if label == "true plant":
            best = {key: found.objective for key, found in scores.items()}
        print_row(label, planned, scores, best, len(instances))


def print_row(label: str, planned: int, scores: dict[str, Score], best: dict[str, float], count: int) -> None:
    """Medians over what can be followed."""
    found = list(scores.values())
    if not found:
        print(f"| {label} | {planned} | 0 | – | – | – | – | 0 % |", flush=True)
        return
    mean, swing, excess = (
        1e3 * np.median([getattr(s, field) for s in found])
        for field in ("mean_freq_max_hz", "swing_max_hz", "freq_violation_hz")
    )
    gaps = [100 * (s.objective / best[key] - 1) for key, s in scores.items() if key in best]
    gap = f"{np.median(gaps):+.3f}" if gaps else "–"
    share = 100 * sum(s.feasible for s in found) / count
    medians = f"{mean:.2f} | {swing:.2f} | {excess:.2f} | {gap}"
    print(f"| {label} | {planned} | {len(found)} | {medians} | {share:.0f} % |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
