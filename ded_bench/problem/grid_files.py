"""Files of a grid with full machine models: `network.json`, the AC network, and `machines.json`.

Powers, voltages and network impedances are in pu of BASE_MVA; the data of a machine are on its own rating,
`mva`; times are in s, angles of buses in degrees. The models are ANDES's of the same names.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, WrapValidator, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, Record, of_kind, parse_record, read_text
from ded_bench.problem.quantities import SMALLEST, Magnitude, Name, NonNegative, Number, Positive, TimeConst

BASE_MVA = 100.0
GRID_FILES = NETWORK_FILE, MACHINES_FILE = "network.json", "machines.json"
#: How far the shares of the machines at a bus may be from 1 in sum.
SHARES = 1e-6


class AcBus(Record):
    """A bus of the solved power flow: generated and consumed power, and a shunt, all in pu."""

    id: Name
    v: Magnitude
    angle_deg: Annotated[float, Field(ge=-360, le=360)]
    pg: Number
    qg: Number
    pd: Number
    qd: Number
    gs: Number
    bs: Number


class AcLine(Record):
    """A line or transformer: r + jx in series, charging b, the tap at `from`; pu."""

    from_bus: Name = Field(alias="from")
    to_bus: Name = Field(alias="to")
    r: NonNegative
    x: Number
    b: Number
    tap: Magnitude
    shift_deg: Annotated[float, Field(ge=-360, le=360)]

    @model_validator(mode="after")
    def _impedance(self) -> AcLine:
        if abs(complex(self.r, self.x)) < SMALLEST:
            raise ValueError("r, x: a line without impedance")
        return self


class ClassicalMachine(Record):
    """A classical machine behind x'd, as lossless cases have them."""

    bus: Name
    mva: Magnitude
    xd1: Magnitude
    h: Magnitude
    share: Annotated[float, Field(gt=0, le=1)]


class NetworkFile(Fingerprinted):
    """`network.json`: an AC network and its nominal operating point."""

    case: Name | None = None
    source: str | dict[Name, str] | None = None
    base_mva: float
    slack_machine_bus: Name
    buses: Annotated[tuple[AcBus, ...], Field(min_length=1)]
    lines: tuple[AcLine, ...]
    machines: tuple[ClassicalMachine, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> NetworkFile:
        _check_base(self.base_mva)
        names = {bus.id for bus in self.buses}
        if len(names) != len(self.buses):
            raise ValueError("buses: two buses have the same id")
        known = {"slack_machine_bus": [self.slack_machine_bus], "machines": [m.bus for m in self.machines]}
        for field, buses in known.items():
            if unknown := [bus for bus in buses if bus not in names]:
                raise ValueError(f"{field}: there is no bus {unknown[0]}")
        check_connected(names, self.lines, self.slack_machine_bus, f"bus {self.slack_machine_bus}")
        return self


def check_connected(names: set[str], lines: Any, start: str, called: str) -> None:
    """Raise ValueError unless lines (`from_bus`, `to_bus`) join all buses to the start, which it calls so."""
    neighbours: dict[str, set[str]] = {name: set() for name in names}
    for line in lines:
        if line.from_bus == line.to_bus or {line.from_bus, line.to_bus} - names:
            raise ValueError(f"lines: {line.from_bus}-{line.to_bus} does not join two known buses")
        neighbours[line.from_bus].add(line.to_bus)
        neighbours[line.to_bus].add(line.from_bus)
    apart, found = names - {start}, [start]
    while found:
        new = neighbours[found.pop()] & apart
        apart -= new
        found += new
    if apart:
        raise ValueError(f"lines: bus {min(apart)} is not connected to {called}")


def _of_its_model(*kinds: type[Record]) -> WrapValidator:
    """Read a record as the model that it names."""
    by_model = {kind.__name__.upper(): kind for kind in kinds}

    def choose(value: dict[str, Any]) -> type[Record]:
        if (model := str(value.get("model"))) not in by_model:
            raise ValueError(f"model: must be one of {', '.join(by_model)}")
        return by_model[model]

    return of_kind(choose, *kinds)


class Sexs(Record):
    """Static exciter: (1 + s ta) / (1 + s tb) · k / (1 + s te)."""

    model: Literal["SEXS"]
    k: Positive
    ta: NonNegative
    tb: TimeConst
    te: TimeConst


class Ieeex1(Record):
    """DC exciter with a rate feedback; `ke` may be negative."""

    model: Literal["IEEEX1"]
    ka: Positive
    ta: TimeConst
    te: TimeConst
    ke: Number
    kf: NonNegative
    tf: TimeConst


class St2cut(Record):
    """Stabiliser, from speed: ks · s tw / (1 + s tw) · (1 + s t1) / (1 + s t2) · (1 + s t3) / (1 + s t4)."""

    model: Literal["ST2CUT"]
    ks: Number
    tw: TimeConst
    t1: NonNegative
    t2: TimeConst
    t3: NonNegative
    t4: TimeConst


class Tgov1(Record):
    """Steam turbine and governor with droop r: (p_ref - w / r) / (1 + s t1) · (1 + s t2) / (1 + s t3)."""

    model: Literal["TGOV1"]
    r: Magnitude
    t1: TimeConst
    t2: NonNegative
    t3: TimeConst


class _ModelledMachine(Record):
    name: Name
    bus: Name
    share: Annotated[float, Field(gt=0, le=1)]  # of the generation at the bus
    mva: Magnitude
    h: Magnitude  # s
    d: NonNegative
    governor: Tgov1

    @property
    def inertia(self) -> float:
        """M = 2 h in s, on BASE_MVA."""
        return 2 * self.h * self.mva / BASE_MVA


class Genrou(_ModelledMachine):
    """Round rotor: two windings in each axis, no saturation, x''q = x''d."""

    model: Literal["GENROU"]
    xd: Magnitude
    xq: Magnitude
    xd1: Magnitude
    xq1: Magnitude
    xd2: Magnitude
    xl: NonNegative
    Td10: TimeConst
    Tq10: TimeConst
    Td20: TimeConst
    Tq20: TimeConst
    exciter: Annotated[Sexs | Ieeex1, _of_its_model(Sexs, Ieeex1)] | None
    pss: Annotated[St2cut, _of_its_model(St2cut)] | None

    @model_validator(mode="after")
    def _possible(self) -> Genrou:
        for axis in (("xd", "xd1", "xd2"), ("xq", "xq1", "xd2")):
            for larger, smaller in itertools.pairwise(axis):
                if getattr(self, larger) < getattr(self, smaller):
                    raise ValueError(f"{larger}: is below {smaller}")
        if not self.xd2 > self.xl:
            raise ValueError("xl: must be below xd2")
        if self.pss is not None and self.exciter is None:
            raise ValueError("pss: needs an exciter")
        return self


class Gencls(_ModelledMachine):
    """Classical machine: constant voltage behind x'd."""

    model: Literal["GENCLS"]
    xd1: Magnitude
    exciter: None
    pss: None


class MachinesFile(Fingerprinted):
    """`machines.json`: machines, exciters, stabilisers and governors."""

    schema_: Literal["detailed/1"] = Field(alias="schema")
    case: Name
    f0_hz: Magnitude
    base_mva: float
    network: str | None = None
    slack_machine_bus: Name
    source: str | None = None
    licence: str | None = None
    notes: tuple[str, ...] = ()
    machines: Annotated[
        tuple[Annotated[Genrou | Gencls, _of_its_model(Genrou, Gencls)], ...], Field(min_length=1)
    ]

    @model_validator(mode="after")
    def _consistent(self) -> MachinesFile:
        _check_base(self.base_mva)
        if len({m.name for m in self.machines}) != len(self.machines):
            raise ValueError("machines: two machines have the same name")
        for bus in {m.bus for m in self.machines}:
            if abs(sum(m.share for m in self.machines if m.bus == bus) - 1) > SHARES:
                raise ValueError(f"machines: the shares at bus {bus} do not sum to 1")
        if [m.bus for m in self.machines].count(self.slack_machine_bus) != 1:
            raise ValueError(f"slack_machine_bus: one machine is needed at bus {self.slack_machine_bus}")
        return self


def _check_base(base_mva: float) -> None:
    if base_mva != BASE_MVA:
        raise ValueError(f"base_mva: must be {BASE_MVA:g}")


class GridFiles(Fingerprinted):
    """Network and machines that belong together."""

    network: NetworkFile
    data: MachinesFile

    @functools.cached_property
    def machines(self) -> dict[str, Genrou | Gencls]:
        """The machines by name, in the order of the file."""
        return {machine.name: machine for machine in self.data.machines}

    @functools.cached_property
    def slack(self) -> str:
        """Name of the machine at `slack_machine_bus`."""
        return next(m.name for m in self.data.machines if m.bus == self.data.slack_machine_bus)


#: A file's record; many instances' files have the same case beside them.
_parsed: Callable[..., Any] = functools.lru_cache(maxsize=32)(parse_record)


def load_grid_files(folder: Path, case: str, f0_hz: float) -> GridFiles:
    """Read `network.json` and `machines.json` of a case's folder.

    Raises:
        InputError: a file is missing or wrong, or they do not fit together or to the case.
    """
    place, other = folder / MACHINES_FILE, folder / NETWORK_FILE
    network = _parsed(NetworkFile, read_text(other), other)
    data = _parsed(MachinesFile, read_text(place), place)
    for path, named in ((other, network.case), (place, data.case)):
        if named not in (None, case):
            raise InputError(path, "case", f"is {named!r}, not {case!r}")
    if data.f0_hz != f0_hz:
        raise InputError(place, "f0_hz", f"is {data.f0_hz:g}, and the case's {f0_hz:g}")
    if data.slack_machine_bus != network.slack_machine_bus:
        raise InputError(place, "slack_machine_bus", f"is another one than in {NETWORK_FILE}")
    buses = {bus.id for bus in network.buses}
    for number, machine in enumerate(data.machines):
        if machine.bus not in buses:
            raise InputError(place, f"machines.{number}.bus", f"{NETWORK_FILE} has no bus {machine.bus}")
    return GridFiles(network=network, data=data)
