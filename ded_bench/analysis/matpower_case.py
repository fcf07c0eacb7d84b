"""A lossless case (case/2) of a MATPOWER grid and its machines' dynamics, by the rules of docs/grid_data.md.

A MATPOWER file is parsed, never executed.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ded_bench.analysis.inspect_case import suggested_knots
from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record, read_text
from ded_bench.files.table import Table, records
from ded_bench.plants.detailed.power_flow import Complex, port_network
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.grid_files import BASE_MVA
from ded_bench.problem.lossless_case import LosslessCase, lossless
from ded_bench.problem.quantities import Array
from ded_bench.problem.sampling import rounded

_COMMENT = re.compile(r"('[^'\n]*')|%[^\n]*|\.\.\.[^\n]*\n")  # in a string a % is none
_STATEMENT = re.compile(
    r"\s*(?:function\b[^\n]*|(?:end|return)\s*;?(?=\s|$)"
    r"|\w+\.(?P<name>[\w.]+)\s*="
    r"\s*(?:\[(?P<matrix>[^\]]*)\]|\{[^}]*\}|'[^'\n]*'|(?P<number>[-+.\w]+))[ \t]*(?:;|\n|$))"
)


def read_matpower(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """The matrices and numbers that a file assigns, by name; a number is of shape (1, 1).

    Raises:
        InputError: the file cannot be read, or has anything but assignments, whose effect would be missing.
    """
    text = _COMMENT.sub(r"\1", "\n".join(_outside_blocks(read_text(path))))
    found, place = {}, 0
    while text[place:].strip():
        statement = _STATEMENT.match(text, place)
        if statement is None:
            said = text[place:].strip().splitlines()[0][:60]
            raise InputError(path, repr(said)[1:-1], "only assignments of plain data are read")
        place = statement.end()
        if (content := statement["matrix"] or statement["number"]) is not None:
            lines = re.split(r"[;\n]", content)
            rows = [line.replace(",", " ").split() for line in lines if line.strip(" ,\t\r")]
            found[statement["name"]] = _matrix(path, statement["name"], rows)
    return found


def _outside_blocks(text: str) -> Iterator[str]:
    """Lines that stand in no block comment: %{ and %}, each alone on its line, which may be nested."""
    depth = 0
    for line in text.splitlines():
        depth += line.strip() == "%{"
        if not depth:
            yield line
        elif line.strip() == "%}":
            depth -= 1


def _matrix(path: str | Path, name: str, rows: list[list[str]]) -> NDArray[np.float64]:
    values = np.zeros((len(rows), max(map(len, rows), default=0)))
    for i, row in enumerate(rows):
        if len(row) != values.shape[1]:
            raise InputError(path, f"{name}, row {i + 1}", f"has {len(row)} values, not {values.shape[1]}")
        for j, cell in enumerate(row):
            try:
                values[i, j] = float(cell)
            except ValueError:
                raise InputError(path, f"{name}, row {i + 1}", f"{cell[:20]!r} is not a number") from None
            if math.isnan(values[i, j]):
                raise InputError(path, f"{name}, row {i + 1}", "has what is not a number")
    return values


#: What is assumed of every machine, as on the shipped grids: d / m, 1/s.
DAMPING = 0.3
#: Matrices of more buses, which are full, would fill the memory.
MOST_BUSES = 5000
#: Where H and x'd stand among the numbers of a PSS/E dyr record, by its model.
DYR = {"GENROU": (4, 8), "GENROE": (4, 8), "GENSAL": (3, 7), "GENSAE": (3, 7)}
#: Columns of MATPOWER's matrices that are read.
COLUMNS = {
    "baseMVA": [0],
    "bus": range(9),
    "gen": [0, 1, 2, 5, 6, 7, 8, 9],
    "branch": [0, 1, 2, 3, 4, 8, 9, 10],
}
Above = Annotated[float, Field(gt=0)]


@dataclass(frozen=True)
class Dynamics:
    """What is known of a machine beside the MATPOWER file; its limits are on 100 MVA."""

    bus: int
    h: Above  # s, on its own base; likewise x'd, pu
    xd1: Above
    mva: Above | None = None
    p_min: float | None = None
    p_max: float | None = None
    ramp_pu_per_s: float | None = None


DYNAMICS = Table(Dynamics)


class MatpowerGrid(NamedTuple):
    """What is in service of a MATPOWER file."""

    path: str | Path
    base_mva: float
    bus: Array
    gen: Array
    branch: Array
    places: dict[int, int]  # rows of the buses by their numbers
    machines: Array  # bus of every machine, and whether it is in service, (n, 2)

    @property
    def reference(self) -> int:
        """Number of the reference bus."""
        return int(self.bus[self.bus[:, 1] == 3, 0][0])


class Unit(NamedTuple):
    """A machine in service, powers and limits on 100 MVA."""

    bus: int
    name: str
    power: complex
    mva: float
    h: float  # s, on its own base; likewise x'd, pu
    xd1: float
    p_min: float
    p_max: float
    ramp: float | None


def imported(path: str | Path, dynamics: str | Path, name: str, like: Case | None = None) -> LosslessCase:
    """Make a case.

    Args:
        path: MATPOWER file; it is parsed, not executed.
        dynamics: CSV with columns bus, h (s), xd1 (pu), both on the machine's base, and perhaps mva, p_min
            and p_max (pu of 100 MVA), ramp_pu_per_s; machines at one bus in the order of the MATPOWER file.
            Or a PSS/E dyr file with GENROU, GENROE, GENSAL or GENSAE records. Of a bus they have
            all machines, or those in service.
        name: id of the case.
        like: gives nominal frequency, ramp limit, regimes and the sampler's ranges; None: see `alike`.

    Raises:
        InputError: a file is wrong, or a machine lacks data; it is named.
        SimulationError: the lossless network has no equilibrium at nominal powers.
    """
    grid, known = _grid(path), _dynamics(dynamics)
    voltage, generated = _power_flow(grid)
    units = _units(grid, dynamics, known, generated)
    like = alike(len(grid.bus) + len(units)) if like is None else lossless(like)
    data = _record(grid, name, like, units, voltage)
    case = parse_record(LosslessCase, json.dumps(data), path)
    fastest = float(np.abs(plant_of(case).nominal().modes).max()) / (2 * np.pi)
    return parse_record(LosslessCase, json.dumps(data | {"knots": suggested_knots(case, fastest)}), path)


def alike(n_bus: int) -> Case:
    """The shipped physical lossless case with the most similar number of buses."""
    cases = map(Case.load, sorted(SHIPPED_CASES.glob("*/case.json")))
    lossless = [case for case in cases if case.schema_ == "ded-bench/case/2"]
    return min(lossless, key=lambda case: abs(math.log(case.n_bus / n_bus)))


def _grid(path: str | Path) -> MatpowerGrid:
    found = read_matpower(path)
    for name, columns in COLUMNS.items():
        if name not in found or found[name].shape[1] <= max(columns) or not len(found[name]):
            raise InputError(path, f"mpc.{name}", f"is needed, with {max(columns) + 1} columns or more")
        finite = [column for column in columns if (name, column) not in (("gen", 8), ("gen", 9))]
        if not np.isfinite(found[name][:, finite]).all():
            raise InputError(path, f"mpc.{name}", "has a value that is not finite")
    bus = found["bus"][found["bus"][:, 1] != 4]
    if len(bus) > MOST_BUSES:
        raise InputError(path, "mpc.bus", f"has more than {MOST_BUSES} buses")
    branch, gen = found["branch"][found["branch"][:, 10] > 0], found["gen"][found["gen"][:, 7] > 0]
    places = {int(row[0]): i for i, row in enumerate(bus)}
    if len(places) < len(bus):
        raise InputError(path, "mpc.bus", "two have the same number")
    if lost := sorted({*gen[:, 0], *branch[:, :2].flat} - {*bus[:, 0]}):
        problem = f"{lost[0]:g} is missing or out of service, and has a machine or branch in service"
        raise InputError(path, "mpc.bus", problem)
    if list(bus[:, 1]).count(3) != 1 or not (gen[:, 0] == bus[bus[:, 1] == 3, 0]).any():
        raise InputError(path, "mpc.bus", "exactly one reference bus (type 3) with a machine is needed")
    base, every = float(found["baseMVA"][0, 0]), found["gen"]
    if base <= 0 or (bus[:, 7] <= 0).any():
        raise InputError(path, "mpc", "baseMVA and the size of all voltages must be above 0")
    machines = np.stack([every[:, 0], every[:, 7] > 0], axis=1)
    return MatpowerGrid(path, base, bus, gen, branch, places, machines)


def _dynamics(path: str | Path) -> dict[int, list[Dynamics]]:
    """Data of machines by bus, in the order of the file."""
    if Path(path).suffix.lower() == ".dyr":
        header, lines = ["bus", "h", "xd1"], list(_of_dyr(read_text(path)))
    else:
        (_, header), *lines = records(read_text(path), path) or [(0, [])]
        header = list(DYNAMICS.check_header([cell.strip() for cell in header], path))
        if unknown := [name for name in header if name not in DYNAMICS.names]:
            raise InputError(path, unknown[0][:40], f"unknown column (known: {', '.join(DYNAMICS.names)})")
    found: dict[int, list[Dynamics]] = {}
    for one in DYNAMICS.rows(lines, header, path):
        found.setdefault(one.bus, []).append(one)
    return found


def _of_dyr(text: str) -> Iterator[tuple[int, list[str]]]:
    """Line, bus, H and x'd of every record of a machine."""
    text = "\n" + text
    for record in re.finditer(r"([^/]+)/[^\n]*", text):  # what follows a record is a comment
        words = re.sub(r"['\",]", " ", record[1]).split()
        if len(words) > 2 and (columns := DYR.get(words[1].upper())):
            line = text.count("\n", 0, record.end())
            yield line, [words[0], *(words[3 + c] for c in columns if 3 + c < len(words))]


def _power_flow(grid: MatpowerGrid) -> tuple[Complex, Complex]:
    """Voltages, and powers generated at the buses, of the solved AC power flow, pu of 100 MVA."""
    path, base, bus, gen, branch, places, _ = grid
    held = np.isin(bus[:, 0], gen[:, 0]) & (bus[:, 1] != 1)
    generated, size = np.zeros(len(bus), dtype=np.complex128), bus[:, 7].copy()
    for row in gen:
        place = places[int(row[0])]
        generated[place] += complex(row[1], row[2]) / BASE_MVA
        size[place] = row[5] if held[place] else size[place]
    buses, lines = [], []
    for row, v, s in zip(bus, size, generated, strict=True):
        powers = dict(zip(("pd", "qd", "gs", "bs"), (row[2:6] / BASE_MVA).tolist(), strict=True))
        buses.append(SimpleNamespace(id=row[0], v=v, angle_deg=row[8], pg=s.real, qg=s.imag, **powers))
    for row in branch:
        if row[2] == row[3] == 0:
            raise InputError(path, f"mpc.branch {row[0]:g}-{row[1]:g}", "has no impedance")
        r, x, b = row[2] * BASE_MVA / base, row[3] * BASE_MVA / base, row[4] * base / BASE_MVA
        given = {"r": r, "x": x, "b": b, "tap": row[8] or 1.0, "shift_deg": row[9]}
        lines.append(SimpleNamespace(from_bus=row[0], to_bus=row[1], **given))
    network = SimpleNamespace(buses=buses, lines=lines, slack_machine_bus=grid.reference)
    stations = [SimpleNamespace(bus=number, share=1.0) for number in bus[held, 0]]
    try:
        ports = port_network(network, SimpleNamespace(machines=stations))
        point = ports.nominal()
    except (SimulationError, np.linalg.LinAlgError):
        raise InputError(path, "mpc", "the AC power flow has no solution from the voltages given") from None
    generated[held] = point.power
    return ports.spread @ point.voltage, generated


def _units(
    grid: MatpowerGrid, dynamics: str | Path, known: dict[int, list[Dynamics]], generated: Complex
) -> list[Unit]:
    """Machines in service; those of a bus share reactive power by rating, the reference's first balances."""
    by_bus: dict[int, list[Array]] = {}
    for row in grid.gen:
        by_bus.setdefault(int(row[0]), []).append(row)
    if missing := [number for number, rows in by_bus.items() if len(known.get(number, [])) < len(rows)]:
        buses = ", ".join(map(str, missing[:10])) + (" ..." if len(missing) > 10 else "")
        raise InputError(dynamics, "h, xd1", f"are needed of every machine in service, also at bus {buses}")
    units = []
    for number, rows in by_bus.items():
        own, total = known[number], generated[grid.places[number]]
        in_service = grid.machines[grid.machines[:, 0] == number, 1]
        if len(own) == len(in_service):
            own = list(itertools.compress(own, in_service))
        if len(own) != len(rows):
            problem = f"{len(own)} rows for bus {number}, which has {len(rows)} machines in service"
            raise InputError(dynamics, "bus", f"{problem}, {len(in_service)} in all")
        rating = [one.mva or float(row[6]) for one, row in zip(own, rows, strict=True)]
        if min(rating) <= 0:
            raise InputError(dynamics, "mva", f"is needed of the machine at bus {number}")
        p = [float(row[1]) / BASE_MVA for row in rows]
        if number == grid.reference:  # elsewhere the power flow keeps them, but for round-off
            p[0] += float(total.real) - sum(p)
        for k, (one, row) in enumerate(zip(own, rows, strict=True)):
            letter = chr(ord("a") + k) if len(rows) > 1 else ""
            power = complex(p[k], float(total.imag) * rating[k] / sum(rating))
            ends = (one.p_min, row[9]), (one.p_max, row[8])
            low, high = (float(p) / BASE_MVA if own is None else own for own, p in ends)
            given = f"g{number}{letter}", power, rating[k], one.h, one.xd1, low, high
            units.append(Unit(number, *given, one.ramp_pu_per_s))
    return units


def _record(
    grid: MatpowerGrid, name: str, like: Case, units: Sequence[Unit], voltage: Complex
) -> dict[str, Any]:
    """The case's file, without knots."""
    buses, lines, machines = [], [], {}
    slack = next(unit for unit in units if unit.bus == grid.reference)
    for row, v in zip(grid.bus, np.abs(voltage), strict=True):
        load = {"p_nominal": _plain(-row[2] / BASE_MVA)} if row[2] else {}
        buses.append({"id": f"{row[0]:.0f}", "kind": "load" if load else "junction", "v": _plain(v), **load})
    for row in grid.branch:
        factor = (row[8] or 1.0) * BASE_MVA / grid.base_mva
        ends = {"from": f"{row[0]:.0f}", "to": f"{row[1]:.0f}"}
        if row[3] <= 0 or row[2] < 0:
            where = f"mpc.branch {ends['from']}-{ends['to']}"
            raise InputError(grid.path, where, "needs r of at least 0 and x above 0 in a lossless network")
        lines.append({**ends, "r": _plain(row[2] * factor), "x": _plain(row[3] * factor)})
    for unit in units:
        x, v = unit.xd1 * BASE_MVA / unit.mva, abs(voltage[grid.places[unit.bus]])
        internal = abs(v + 1j * x * np.conj(unit.power) / v)
        kind = "slack" if unit is slack else "generator"
        buses.append({"id": unit.name, "kind": kind, "v": _plain(internal)})
        lines.append({"from": str(unit.bus), "to": unit.name, "r": 0.0, "x": _plain(x)})
        if unit is slack:
            continue
        p = unit.power.real
        if not unit.p_min <= p <= unit.p_max or not 0 < unit.p_max - unit.p_min < math.inf:
            within = f"{unit.p_min:g} to {unit.p_max:g}"
            problem = f"{p:g} pu is not within its limits, {within}; the dynamics may give p_min, p_max"
            raise InputError(grid.path, f"machine at bus {unit.bus}", problem)
        m = 2 * unit.h * unit.mva / (2 * np.pi * like.f0_hz * BASE_MVA)
        machine = {"m": m, "d": DAMPING * m, "p_nominal": p, "p_min": unit.p_min, "p_max": unit.p_max}
        machine |= {} if unit.ramp is None else {"ramp_pu_per_s": unit.ramp}
        machines[unit.name] = {key: _plain(value) for key, value in machine.items()}
    source = {
        "data": f"{Path(grid.path).name}, dynamics of its machines",
        "conversion": f"ded-bench import; assumed: d / m = {DAMPING:g} 1/s; frequency, ramp limit, "
        f"regimes and sampling as in {like.id}",
    }
    kept = {"f0_hz", "ramp_pu_per_s", "regimes", "sampling"}
    data: dict[str, Any] = {"schema": "ded-bench/case/2", "id": name, "source": source}
    data |= json.loads(like.model_dump_json(by_alias=True, include=kept))
    return data | {"buses": buses, "lines": lines, "machines": machines}


def _plain(value: float) -> float:
    return float(rounded(np.array(value)))
