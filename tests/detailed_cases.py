"""Cases on the detailed plant for tests, and what ANDES 2.0 says of the shipped grids."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import Array
from ded_bench.problem.schedule import Schedule

GRIDS = ("two-area", "39bus", "68bus", "140bus")
VARIANTS = ("infinite", "island", "island-agc")
#: An island with everything that a grid may have: two machines at a bus, all models, a machine without
#: exciter, a shunt, a tap, a phase shift, a feed-in, a junction; 50 Hz; generators in an own order.
MIXED = Path(__file__).parent / "cases" / "mixedisland"
#: From ANDES's runs with GENROU, GENCLS, SEXS, IEEEX1, ST2CUT and TGOV1N, every 0.25 s: the ramps, and
#: differences along time of integers in the unit that each name ends with.
TRACES = Path(__file__).parent / "data" / "andes_traces.npz"


class Trace(NamedTuple):
    """What ANDES says."""

    case: Case
    instance: Instance
    schedule: Schedule
    omega: Array  # (n, n_gen), rad/s
    p_gen: Array  # (n, n_gen), pu
    voltage: dict[str, Array]  # at some buses, (n,), pu


def andes_trace(grid: str, variant: str, folder: Path, quiet_instance: Any) -> Trace:
    """One of ANDES's runs, with the case, the loads and the set-points that it had."""
    with np.load(TRACES) as data:
        key = f"{grid}-{variant}"
        header = json.loads(str(data[key]))
        names = "w_nrad_per_s", "pm_e-7pu", "v_e-8pu"
        omega, p_gen, voltage = (np.cumsum(data[f"{key}-{name}"], axis=0, dtype=np.int64) for name in names)
    omega, p_gen, voltage = omega * 1e-9, p_gen * 1e-7, voltage * 1e-8
    machines = header["machines"]
    case = detailed_case(grid, folder, "infinite" if variant == "infinite" else "island", header["agc"])
    load = {
        bus: {"initial": value, "start": 0.0, "duration": 0.0, "rate": 0.0}
        for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
    }
    for bus, (start, duration, rate) in header["load"].items():
        load[bus] |= {"start": start, "duration": duration, "rate": -rate}
    instance = quiet_instance(case, horizon_s=60.0, load=load)
    corners = {t for start, duration, _ in header["setpoint"].values() for t in (start, start + duration)}
    times = np.array(sorted({0.0, 60.0, *corners}))
    p = np.tile(case.p_nominal, (len(times), 1))
    for name, (start, duration, rate) in header["setpoint"].items():
        p[:, case.generators.index(name)] += rate * np.clip(times - start, 0.0, duration)
    columns = [machines.index(name) for name in case.generators]
    at_buses = dict(zip(header["buses"], voltage.T, strict=True))
    return Trace(case, instance, Schedule(times, p), omega[:, columns], p_gen[:, columns], at_buses)


def detailed_case(grid: str, folder: Path, slack: str = "island", agc: dict[str, Any] | None = None) -> Case:
    """A shipped grid with its full machine models as a case of its own."""
    shipped = Case.load(grid)
    files, network = shipped.detailed, shipped.detailed.network
    for name in ("network.json", "machines.json"):
        (folder / name).write_text((SHIPPED_CASES / grid / name).read_text())
    generated = {bus.id: bus.pg for bus in network.buses}
    machines, loads = {}, dict(zip(shipped.loads, shipped.load_nominal.tolist(), strict=True))
    for name, machine in files.machines.items():
        power = machine.share * generated[machine.bus]
        machines[name] = {"p_nominal": power, "p_min": 0.5 * power, "p_max": 1.5 * power}
    if agc is not None:
        total = sum(agc["participation"].values())  # of rounded numbers
        participation = {name: share / total for name, share in agc["participation"].items()}
        agc = {"period_s": agc["period_s"], "k": agc["k"], "participation": participation}
    bounds = (
        {"omega_hz": 0.05} if slack == "infinite" else {"mean_hz": 0.05, "relative_hz": 0.01, "end_hz": 0.01}
    )
    data = {
        "schema": "ded-bench/case/3",
        "id": grid,
        "f0_hz": shipped.f0_hz,
        "plant": {"kind": "detailed", "slack": slack, "agc": agc},
        "machines": machines,
        "loads": {bus: value for bus, value in loads.items() if value < 0},
        "ramp_pu_per_s": shipped.ramp_pu_per_s,
        "regimes": {"NO": bounds},
        "sampling": json.loads(shipped.sampling.model_dump_json()),
    }
    (folder / "case.json").write_text(json.dumps(data))
    return Case.load(folder)
