"""Cut out of drawn scenarios what a reserve is for: steep ramps that nobody announces and nobody can follow.

Kept are stretches around unannounced ramps of more than 2 s that turn a machine at 0.7 of the tight bound or
more if nobody follows, and faster than the bound even if all generators do, from where the static dispatch
has them. Each goes from 20 s before the ramp to 12 s after it, and starts at rest under the static dispatch.

    ded-bench scenarios --case two-area --seed 77 --count 60 --out drawn
    python studies/unannounced_ramps.py drawn stretches
    ded-bench online --case two-area --regime TO --scenario stretches/*.json \
      --method ded-rti --period 0.1 --latency 0.05
"""

import json
import sys
from pathlib import Path

import numpy as np

from ded_bench import Case
from ded_bench.methods.reserve import steady_speeds
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.scenario import Scenario

BEFORE_S, AFTER_S, SHORTEST_S, SLOWEST = 20.0, 12.0, 2.0, 0.7


def dispatch(case, scenario, t):
    """Static dispatch of the loads at a time, (n_gen,), pu."""
    cost = np.array([[scenario.cost[bus] for bus in case.generators]])
    loads = scenario.p_load(case, np.array([t]))
    return merit_order(case, cost, np.array([scenario.cost[case.slack]]), loads)[0]


def is_too_fast(case, grid, scenario, load, ramp):
    """Whether neither rest nor the generators' room keeps all machines within the bound during a ramp."""
    by_load, compliance = grid
    speed = by_load[load] * ramp.rate  # a load that falls is followed downwards
    power = dispatch(case, scenario, ramp.start)
    room = case.p_max - power if ramp.rate < 0 else power - case.p_min
    followed = compliance @ np.minimum(room / ramp.duration, case.ramp)
    bound = case.omega_bound("TO")
    return np.abs(speed).max() >= SLOWEST * bound and (np.abs(speed) - followed > bound).any()


def cut(case, scenario, ramp, name):
    """The scenario around a ramp, as the data of a file."""
    first, duration = ramp.start - BEFORE_S, round(BEFORE_S + ramp.duration + AFTER_S)
    data = json.loads(scenario.model_dump_json(by_alias=True))
    power = dispatch(case, scenario, first)
    data |= {"id": name, "duration_s": float(duration)}
    data["initial"]["power"] = dict(zip(case.generators, power.tolist(), strict=True))
    data["initial"]["omega"] = dict.fromkeys(case.generators, 0.0)
    for bus, load in scenario.load.items():
        path, kept = load.fluctuation, []
        for other in data["load"][bus]["ramps"]:
            start, end = other["start"] - first, other["start"] + other["duration"] - first
            if end > 0:
                announced = other["announced_start"]
                later = None if announced is None else max(announced - first, 0.0)
                begins = max(start, 0.0)
                kept.append(other | {"start": begins, "duration": end - begins, "announced_start": later})
        count = int((duration + case.sampling.horizon_s) / path.step_s) + 3
        times = np.minimum(first + path.step_s * np.arange(count), path.times[-1])
        initial = float(load.at(np.array(first)) - load.fluctuation_at(np.array(first)))
        values = load.fluctuation_at(times).tolist()
        data["load"][bus] |= {"initial": initial, "ramps": kept}
        data["load"][bus]["fluctuation"]["values"] = values
    return data


def stretches(case, scenarios):
    """All stretches of several scenarios, as the data of files."""
    grid, found = steady_speeds(case), []
    for scenario in scenarios:
        for number, bus in enumerate(case.loads):
            for ramp in scenario.load[bus].ramps:
                inside = ramp.start > BEFORE_S + 1.0 and ramp.end < scenario.duration_s
                surprising = ramp.announced_start is None and ramp.duration > SHORTEST_S
                if inside and surprising and is_too_fast(case, grid, scenario, number, ramp):
                    found.append(cut(case, scenario, ramp, f"{case.id}-r{len(found):04d}"))
    return found


if __name__ == "__main__":
    drawn, out = map(Path, sys.argv[1:3])
    case = Case.load("two-area")
    out.mkdir(parents=True, exist_ok=True)
    for data in stretches(case, [Scenario.load_file(path, case) for path in sorted(drawn.glob("*-s*.json"))]):
        (out / f"{data['id']}.json").write_text(json.dumps(data))
        print(data["id"], "of", data["seed"], f"{data['duration_s']:g} s")
