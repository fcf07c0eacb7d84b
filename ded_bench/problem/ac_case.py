"""AC data of a case: lines, transformers, shunts, machines, and the solved nominal power flow."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, Record, read_record
from ded_bench.problem.case import SHIPPED_CASES, Case, Magnitude, Name, NonNegative, Number

Complex = NDArray[np.complex128]

FILE = "ac.json"
#: What `truth` may say: the lossless network of the paper, or the full AC network.
TRUTHS = ("paper", "ac")
#: How well the power flow of a file must hold, pu: files round angles to 1e-8 degrees and |V| to 1e-8.
POWER_FLOW_TOLERANCE = 1e-4
#: How well x'd and inertia of a file must agree with those of the case, relative.
MACHINE_TOLERANCE = 1e-4


class AcBus(Record):
    """A network bus in the nominal power flow; powers and shunts gs + j bs in pu, pd and qd drawn."""

    id: Name
    v: Magnitude
    angle_deg: Number
    pg: Number
    qg: Number
    pd: Number
    qd: Number
    gs: Number
    bs: Number


class AcLine(Record):
    """A line or transformer: r + jx in series, charging b (its whole), ratio tap:1 and shift at `from`."""

    from_bus: Name = Field(alias="from")
    to_bus: Name = Field(alias="to")
    r: NonNegative
    x: Magnitude
    b: NonNegative
    tap: Magnitude
    shift_deg: Number


class AcMachine(Record):
    """A classical machine: rating in MVA, x'd (pu) and H (s) on that rating, its share of its bus's power."""

    bus: Name
    mva: Magnitude
    xd1: Magnitude
    h: Magnitude
    share: Annotated[float, Field(gt=0, le=1)]


class AcCase(Fingerprinted):
    """What the full AC network has beyond a case's lossless one."""

    schema_: Literal["ded-bench/ac/1"] = Field(alias="schema", default="ded-bench/ac/1")
    source: str | dict[Name, str]
    base_mva: Magnitude
    slack_machine_bus: int | Name
    buses: tuple[AcBus, ...]
    lines: tuple[AcLine, ...]
    machines: tuple[AcMachine, ...]

    @model_validator(mode="after")
    def _consistent(self) -> AcCase:
        names = [bus.id for bus in self.buses]
        if len(set(names)) != len(names):
            raise ValueError("buses: two buses have the same id")
        for line in self.lines:
            if line.from_bus == line.to_bus or {line.from_bus, line.to_bus} - set(names):
                raise ValueError(f"lines: {line.from_bus}-{line.to_bus} does not join two known buses")
        at: dict[str, list[float]] = {}
        for machine in self.machines:
            at.setdefault(machine.bus, []).append(machine.share)
        if unknown := sorted(set(at) - set(names)):
            raise ValueError(f"machines: no bus {unknown[0]}")
        if len(at.get(str(self.slack_machine_bus), ())) != 1:
            raise ValueError("slack_machine_bus: exactly one machine must be there")
        for bus, shares in at.items():
            if abs(sum(shares) - 1) > 1e-6:
                raise ValueError(f"machines: shares at bus {bus} do not sum to 1")
        off = np.abs(self.voltage * np.conj(self.admittance @ self.voltage) - self._injections)
        worst = int(np.argmax(off))
        if not off[worst] <= POWER_FLOW_TOLERANCE:
            raise ValueError(f"buses: {names[worst]}: the power flow is off by {off[worst]:.2g} pu here")
        return self

    @staticmethod
    def load(folder: str | Path) -> AcCase:
        """Read the AC data in the folder of a case.

        Raises:
            InputError: there are none, or the file is wrong.
        """
        path = Path(folder) / FILE
        if not path.is_file():
            raise InputError(path, "", "no such file: this case has no AC data")
        return read_record(AcCase, path)

    @staticmethod
    def of(case: Case) -> AcCase:
        """The AC data of a shipped case; InputError if it has none, or is no shipped one."""
        return _shipped(case.id)

    @functools.cached_property
    def index(self) -> dict[str, int]:
        """Places of the buses by id."""
        return {bus.id: i for i, bus in enumerate(self.buses)}

    @functools.cached_property
    def voltage(self) -> Complex:
        """Nominal voltages, shape (n_bus,), pu."""
        angle = np.deg2rad([bus.angle_deg for bus in self.buses])
        return np.asarray([bus.v for bus in self.buses] * np.exp(1j * angle))

    @functools.cached_property
    def admittance(self) -> Complex:
        """Bus admittance matrix with charging, ratios and shunts, shape (n_bus, n_bus), pu."""
        matrix = np.diag([complex(bus.gs, bus.bs) for bus in self.buses])
        for line in self.lines:
            i, j = self.index[line.from_bus], self.index[line.to_bus]
            series, half = 1 / complex(line.r, line.x), 0.5j * line.b
            ratio = line.tap * np.exp(1j * np.deg2rad(line.shift_deg))
            matrix[i, i] += (series + half) / line.tap**2
            matrix[j, j] += series + half
            matrix[i, j] -= series / np.conj(ratio)
            matrix[j, i] -= series / ratio
        return matrix

    @functools.cached_property
    def loads(self) -> Complex:
        """Nominal injections of what is no machine, shape (n_bus,), pu: of constant power, loads negative."""
        machine_buses = {machine.bus for machine in self.machines}
        drawn = np.array([complex(bus.pd, bus.qd) for bus in self.buses])
        other = [0j if bus.id in machine_buses else complex(bus.pg, bus.qg) for bus in self.buses]
        return np.asarray(np.array(other) - drawn)

    @functools.cached_property
    def _injections(self) -> Complex:
        return np.array([complex(bus.pg - bus.pd, bus.qg - bus.qd) for bus in self.buses])

    def reactance(self, machine: AcMachine) -> float:
        """x'd of a machine in pu of the network."""
        return machine.xd1 * self.base_mva / machine.mva

    def machines_of(self, case: Case) -> tuple[AcMachine, ...]:
        """The machines in the order of the case's generators, then the slack's.

        A case's generator or slack is the internal bus of a machine: a line of reactance x'd joins it to
        the machine's bus. Machines that share a bus have the same order here and there.

        Raises:
            InputError: case and AC data do not fit together.
        """
        source = f"AC data of case {case.id}"
        known = {bus.id for bus in case.buses}
        if missing := [bus.id for bus in self.buses if bus.id not in known]:
            raise InputError(source, f"buses.{missing[0]}", "no such bus in the case")
        internal = (*case.generators, case.slack)
        if missing := [b.id for b in case.buses if b.id not in self.index and b.id not in internal]:
            raise InputError(source, "buses", f"bus {missing[0]} of the case is missing")
        ends: dict[str, tuple[str, float]] = {}
        for line in case.lines:
            for bus, other in ((line.from_bus, line.to_bus), (line.to_bus, line.from_bus)):
                if bus in internal:
                    if bus in ends or other not in self.index:
                        raise InputError(source, "machines", f"bus {bus} of the case is no internal bus")
                    ends[bus] = other, line.x
        found: dict[str, AcMachine] = {}
        left = list(self.machines)
        for bus in sorted(internal, key=[b.id for b in case.buses].index):
            terminal, reactance = ends[bus]
            place = next((i for i, machine in enumerate(left) if machine.bus == terminal), None)
            if place is None or not _close(self.reactance(left[place]), reactance):
                raise InputError(source, "machines", f"none at bus {terminal} has the x'd of bus {bus}")
            found[bus] = machine = left.pop(place)
            if bus != case.slack:
                inertia = 2 * machine.h * machine.mva / (2 * np.pi * case.f0_hz * self.base_mva)
                if not _close(inertia, case.machines[bus].m):
                    raise InputError(source, "machines", f"h at bus {terminal} is not that of bus {bus}")
        if left:
            raise InputError(source, "machines", "there are more than the case's")
        if found[case.slack].bus != str(self.slack_machine_bus):
            raise InputError(source, "slack_machine_bus", f"the case's slack is at {found[case.slack].bus}")
        return tuple(found[bus] for bus in internal)


@functools.lru_cache(maxsize=8)
def _shipped(case_id: str) -> AcCase:
    return AcCase.load(SHIPPED_CASES / case_id)


def check_truth(truth: str) -> None:
    """Raise InputError unless there is such a truth."""
    if truth not in TRUTHS:
        raise InputError("truth", truth[:40], f"is not one of {', '.join(TRUTHS)}")


def _close(a: float, b: float) -> bool:
    return abs(a - b) <= MACHINE_TOLERANCE * abs(b)
