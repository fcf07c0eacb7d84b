"""The field's simulator as the last judge: kept schedules through ANDES, in a process of its own.

ANDES is under the GPL and an optional tool. For every schedule this package starts a script (`andes_run`)
with a Python that has ANDES; only plain data pass between them. A schedule is confirmed if its peaks there
keep the bounds of its regime, with an allowance for what two simulators may differ by.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Table
from ded_bench.plants.plant import SimulationError, plant_of, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.quantities import Array
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key, Results, Row

SCRIPT = Path(__file__).with_name("andes_run.py")
#: What ANDES models here.
PLANT = "detailed"
#: What a peak may exceed its bound by and still be confirmed: the larger of a part of it and so many Hz.
RELATIVE, ABSOLUTE_HZ = 0.02, 5e-5


@dataclass(frozen=True)
class RefereeRow:
    """What ANDES says of the kept schedule of one row.

    Peaks are largest sizes over time of what the bounds of each kind are about, in Hz, of those kinds that
    the regime has. `difference_hz` is the largest difference of a machine's frequency from that of our own
    detailed plant, at any time.
    """

    case: str
    instance: str
    regime: str
    method: str
    settings: str
    plant: str
    model: str = ""
    policy: str = ""
    time_limit_s: float | None = None
    peak_omega_hz: float | None = None
    peak_mean_hz: float | None = None
    peak_relative_hz: float | None = None
    peak_end_hz: float | None = None
    confirmed: bool | None = None
    difference_hz: float | None = None
    error: str = ""
    andes: str = ""
    fingerprint: str = ""  # of the schedule and the grid
    method_version: int = 0
    row: str = ""  # fingerprint of the results' row; empty: unknown

    @property
    def key(self) -> Key:
        """The place of the row in the table, that of the results' row."""
        return Key(*(getattr(self, name) for name in Key._fields))


REFEREE = Table(RefereeRow)


def verdict(bounds: Bounds, omega: Array) -> dict[str, Any]:
    """Peaks by kind in Hz, and whether all keep their bounds within the allowance.

    Args:
        bounds: of a regime.
        omega: deviations of the generators, shape (n, n_gen), rad/s.
    """
    still = bounds.tightened(part=1.0)
    allowance = np.maximum(RELATIVE * bounds.limit, 2 * np.pi * ABSOLUTE_HZ)
    allowed = bounds.tightened(by=-allowance)
    peaks = {f"peak_{kind}_hz": peak for kind, peak in still.excess_hz(omega).items()}
    return peaks | {"confirmed": not any(allowed.excess_hz(omega).values())}


def grid_data(case: Case) -> dict[str, Any]:
    """What the script needs to know of a grid.

    Raises:
        InputError: the case has no full machine models.
    """
    grid, agc = case.detailed, case.agc
    return {
        "network": grid.network.model_dump(mode="json", by_alias=True),
        "machines": grid.data.model_dump(mode="json", by_alias=True),
        "infinite": None if case.slack is None else case.machine_of(case.slack),
        "agc": None if agc is None else agc.model_dump(mode="json"),
    }


def run_data(case: Case, instance: Instance, schedule: Schedule) -> dict[str, Any]:
    """What the script needs to know of one run: start, loads drawn and set-points over time, in pu.

    Raises:
        SimulationError: the instance starts from a measured state.
    """
    if (field := instance.initial.measured) is not None:
        raise SimulationError(f"initial.{field}: ANDES starts from equilibria only")
    names = [case.machine_of(name) for name in case.generators]
    loads = {}
    for bus in case.loads:
        load = instance.load[bus]
        times = np.unique([0.0, instance.horizon_s, *(t for t in load.kinks if t < instance.horizon_s)])
        loads[bus] = {"t": times.tolist(), "p": (-load.at(times)).tolist()}
    return {
        "dt_s": instance.dt_s,
        "horizon_s": instance.horizon_s,
        "power": dict(zip(names, instance.p_initial(case).tolist(), strict=True)),
        "omega": dict(zip(names, instance.omega_initial(case).tolist(), strict=True)),
        "t": schedule.t.tolist(),
        "set_points": dict(zip(names, schedule.p.T.tolist(), strict=True)),
        "loads": loads,
    }


def speeds(python: str, grid: Mapping[str, Any], run: Mapping[str, Any]) -> tuple[Array, str]:
    """Run ANDES once, in a process of its own.

    Args:
        python: an interpreter that has ANDES.
        grid: see `grid_data`.
        run: see `run_data`.

    Returns:
        Deviations of all machines, in the order of the grid's file, (n, n_machine), rad/s, at points that are
        equidistant from 0 to the horizon, and the version of ANDES.

    Raises:
        InputError: there is no such interpreter, or it has no ANDES.
        SimulationError: ANDES finds no equilibrium or no later solution, or was killed.
    """
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as folder:
        place, asked = Path(folder) / "speeds.npy", json.dumps({"grid": grid, "run": run})
        told = [python, str(SCRIPT), str(place)]
        try:
            done = subprocess.run(told, input=asked, capture_output=True, text=True, check=False)
        except OSError as error:
            raise InputError(python, "", f"cannot be started ({error.strerror or error})") from None
        if not done.stdout:
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            if last.startswith("ModuleNotFoundError"):
                hint = "skipped; `pip install andes` there, or name another by --python"
                raise InputError(python, "", f"has no ANDES ({last}): {hint}")
            if done.returncode < 0:  # it was killed, perhaps for its memory: others may have an answer
                raise SimulationError(f"ANDES was ended by signal {-done.returncode}")
            raise InputError(python, "", f"ANDES ended without an answer ({last})")
        try:
            answer = json.loads(done.stdout)
            problem, made_by = answer["error"], answer["andes"]
        except (ValueError, LookupError, TypeError):
            raise InputError(python, "", f"is no Python that answers ({done.stdout.strip()[:60]})") from None
        if problem:
            raise SimulationError(problem)
        return np.load(place, allow_pickle=False), made_by


def referee(
    case: Case,
    instances: Mapping[str, Instance],
    results: Results,
    methods: Sequence[str] = (),
    limit: int | None = None,
    python: str = sys.executable,
    workers: int = 1,
) -> list[RefereeRow]:
    """Run kept schedules of a results folder through ANDES; each is saved in `referee.csv` at once.

    An answer that stands there already, of the same schedule on the same grid, is not asked for again.

    Args:
        case: of the rows.
        instances: by id; rows of others are passed over.
        results: whose schedules are judged.
        methods: only rows of these; none: of all.
        limit: of instances; those with most schedules come first, so that methods meet on the same.
        python: an interpreter that has ANDES.
        workers: processes.

    Returns:
        The rows asked for, those that were there included.

    Raises:
        InputError: there is no schedule or no ANDES, or the case has no full machine models.
    """
    grid = grid_data(case)
    table: KeyedTable[Key, RefereeRow] = KeyedTable(results.paths.referee, REFEREE)
    kept = [row for row in results.kept(instances) if not methods or row.method in methods]
    count = Counter(row.instance for row in kept)
    first = sorted(count, key=lambda name: (-count[name], name))[:limit]
    found, todo = [], []
    for row in (row for row in kept if row.instance in first):
        schedule = results.schedule(row, case, instances[row.instance])
        facts = f"{row.fingerprint} {case.detailed.fingerprint}".encode()
        name = hashlib.sha256(facts + schedule.t.tobytes() + schedule.p.tobytes()).hexdigest()[:12]
        if table.made_from(row.key, name) and not table.rows[row.key].error:
            found.append(table.rows[row.key])
        else:
            todo.append((row, schedule, name))

    def judge(row: Row, schedule: Schedule, name: str) -> RefereeRow:
        cells = judged(case, instances[row.instance], schedule, row.regime, grid, python)
        cells |= {"fingerprint": name, "method_version": row.method_version, "row": row.fingerprint}
        return RefereeRow(**row.key._asdict(), plant=PLANT, **cells)

    with ThreadPoolExecutor(workers) as pool:
        waiting = [pool.submit(judge, *asked) for asked in todo]
        try:
            for one in tqdm(as_completed(waiting), total=len(todo), unit="row", disable=None, desc="referee"):
                found.append(one.result())
                table.add(found[-1:])
        finally:
            pool.shutdown(cancel_futures=True)
    table.compact()
    return found


def judged(
    case: Case, instance: Instance, schedule: Schedule, regime: str, grid: Mapping[str, Any], python: str
) -> dict[str, Any]:
    """The cells that ANDES's run of a schedule fills: `verdict`, and the difference from our plant."""
    order = list(case.detailed.machines)
    columns = [order.index(case.machine_of(name)) for name in case.generators]
    try:
        found, version = speeds(python, grid, run_data(case, instance, schedule))
    except SimulationError as error:
        return {"error": str(error)}
    omega = found[:, columns]
    cells = verdict(case.bounds(regime), omega) | {"andes": version}
    try:
        ours = simulate(case, instance, schedule, plant_of(case, PLANT)).omega
    except SimulationError:
        return cells
    theirs = omega[:: max((len(omega) - 1) // (len(ours) - 1), 1)]
    ours = ours[:: max((len(ours) - 1) // (len(omega) - 1), 1)]
    return cells | {"difference_hz": float(np.abs(theirs - ours).max() / (2 * np.pi))}
