"""Is the optimum of full DED the same from every starting point? `python studies/starting_points.py 10`

Instances of 9bus are solved from the state at t = 0, as `ded` does, and from what three schedules do on the
grid: static dispatch, DED-KO on the linearised grid, random set-points followed at the ramp limit.
"""

import sys

import numpy as np
import pandas as pd
import pyomo.environ as pyo

from ded_bench import Case, Instance, Schedule, Settings, Trajectory, load_instances, simulate, solve
from ded_bench.methods import ded, ed
from ded_bench.solvers.ipopt import CasadiIpopt


def random_schedule(case: Case, instance: Instance) -> Schedule:
    """Set-points drawn every 5 s from within the limits, followed at the ramp limit; the same every time."""
    rng = np.random.default_rng(list(instance.fingerprint.encode()))
    targets = rng.uniform(
        case.p_min, case.p_max, size=(round(instance.horizon_s / 5.0), len(case.generators))
    )
    return ed.follow_set_points(case, instance, targets, 5.0)


def set_start(model: pyo.ConcreteModel, case: Case, path: Trajectory) -> None:
    """Make the model's initial point what a schedule does on the grid; fixed values stay."""
    theta = path.columns
    for k, t in enumerate(model.t):
        values = [(model.angle[b, t], theta[f"theta_{b}"][k]) for b in model.algebraic]
        values.append((model.p_slack_up[t], max(path.p_slack[k], 0.0)))
        values.append((model.p_slack_down[t], max(-path.p_slack[k], 0.0)))
        if k:
            for j, g in enumerate(case.generators):
                values.append((model.theta[g, t], theta[f"theta_{g}"][k]))
                values.append((model.omega[g, t], path.omega[k, j]))
                values.append((model.p_gen[g, t], path.p_gen[k, j]))
        for variable, value in values:
            variable.set_value(float(value), skip_validation=True)


def main(count: int) -> None:
    """Print the change of the objective and the iterations from each starting point."""
    case = Case.load("9bus")
    instances = load_instances("9bus", limit=count)
    model = ded.build_ded(case, instances[0].steps, instances[0].dt_s)
    compiled = CasadiIpopt(model, {"min_refinement_steps": 0})
    rows = []
    for regime in case.regimes:
        for instance in instances:
            starts = {
                "cold": None,
                "ed": solve(instance, "ed", regime, settings=Settings("every=1")).schedule,
                "ko": solve(instance, "ded-ko", regime, settings=Settings(model="linear")).schedule,
                "random": random_schedule(case, instance),
            }
            for name, schedule in starts.items():
                ded.set_instance(model, case, instance, regime)
                if schedule is not None:
                    set_start(model, case, simulate(instance, schedule, case))
                outcome = compiled.solve(None)
                rows.append((regime, name, instance.id, outcome.objective, outcome.iterations))
    table = pd.DataFrame(rows, columns=["regime", "start", "instance", "objective", "iterations"])
    cold = table.groupby(["regime", "instance"])["objective"].transform("first")
    table["change_percent"] = 100 * (table["objective"] / cold - 1)
    grouped = table.groupby(["regime", "start"], sort=False)
    print(grouped.agg({"change_percent": ["min", "max"], "iterations": "median"}).to_string())


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
