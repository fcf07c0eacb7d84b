"""Cases of a lossless grid (case/1, case/2): buses, lines and classical machines."""

from __future__ import annotations

import functools
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record
from ded_bench.problem.case import Case, Sampling
from ded_bench.problem.grid_files import check_connected
from ded_bench.problem.limits import Regime, ScheduledMachine
from ded_bench.problem.quantities import Array, Magnitude, Name, NonNegative, Number


class Bus(Record):
    """A node with fixed voltage magnitude `v` in pu (paper, Table I)."""

    id: Name
    kind: Literal["slack", "generator", "load", "junction"]
    v: Magnitude
    p_nominal: Number | None = None  # loads only: nominal injection in pu, negative


class Line(Record):
    """A series impedance r + jx in pu between two buses (paper, Table II)."""

    from_bus: Name = Field(alias="from")
    to_bus: Name = Field(alias="to")
    r: NonNegative
    x: Magnitude


class Swing(Record):
    """Inertia m (s² pu/rad) and damping d (s pu/rad) of one generator."""

    m: Magnitude
    d: NonNegative


class Machine(ScheduledMachine, Swing):
    """Inertia and damping, power limits in pu and ramp limit of one generator."""


class LosslessCase(Case):
    """One grid. Buses keep the file's order; generators and loads are named by their bus."""

    plant_name, usual_knots = "lossless", 50

    schema_: Literal["ded-bench/case/1", "ded-bench/case/2"] = Field(alias="schema")
    id: Name
    source: str | dict[Name, str] | None = None  # case/2: where the data come from, and their licence
    f0_hz: Magnitude
    buses: tuple[Bus, ...]
    lines: tuple[Line, ...]
    machines: dict[Name, Machine]
    ramp_pu_per_s: Magnitude
    regimes: dict[Name, Regime]
    sampling: Sampling
    knots: Annotated[int, Field(ge=2, le=100_000)] | None = None  # case/2: `n_knots`

    @model_validator(mode="after")
    def _consistent(self) -> LosslessCase:
        names = [bus.id for bus in self.buses]
        if len(set(names)) != len(names):
            raise ValueError("buses: two buses have the same id")
        if [bus.kind for bus in self.buses].count("slack") != 1:
            raise ValueError("buses: exactly one slack bus is needed")
        if not self.generators or not self.loads:
            raise ValueError("buses: at least one generator and one load bus are needed")
        if set(self.machines) != set(self.generators):
            raise ValueError("machines: must name exactly the generator buses")
        if not self.regimes:
            raise ValueError("regimes: at least one regime is needed")
        for bus in self.buses:
            if (bus.kind == "load") != (bus.p_nominal is not None):
                raise ValueError(f"buses: {bus.id}: p_nominal belongs to load buses, and to all of them")
        check_connected(set(names), self.lines, self.slack, "the slack bus")
        given = {*self.model_fields_set, *(f"sampling.{name}" for name in self.sampling.model_fields_set)}
        given |= {f"machines.{bus}.{n}" for bus, m in self.machines.items() for n in m.model_fields_set}
        newer = {"source", "knots", "sampling.rate_relative_per_s"}
        newer |= {f"machines.{bus}.ramp_pu_per_s" for bus in self.machines}
        if self.schema_ == "ded-bench/case/1" and given & newer:
            raise ValueError(f"{min(given & newer)}: belongs to schema ded-bench/case/2")
        return self

    @functools.cached_property
    def slack(self) -> str:
        """Id of the slack bus."""
        return next(bus.id for bus in self.buses if bus.kind == "slack")

    @functools.cached_property
    def generators(self) -> tuple[str, ...]:
        """Ids of the generator buses (the paper's 𝒢, without the slack)."""
        return tuple(bus.id for bus in self.buses if bus.kind == "generator")

    @functools.cached_property
    def loads(self) -> tuple[str, ...]:
        """Ids of the load buses (the paper's ℒ)."""
        return tuple(bus.id for bus in self.buses if bus.kind == "load")

    @functools.cached_property
    def load_nominal(self) -> Array:
        """Nominal load injections, shape (n_load,), pu (negative)."""
        return np.array([bus.p_nominal for bus in self.buses if bus.kind == "load"], dtype=float)

    @functools.cached_property
    def inertia(self) -> Array:
        """Inertia m of the generators, shape (n_gen,), s² pu/rad."""
        return np.array([self.machines[g].m for g in self.generators])

    @property
    def n_bus(self) -> int:
        """Number of buses, those inside machines included."""
        return len(self.buses)

    def machine_of(self, name: str) -> str:
        """Generator `g<name>` is machine `<name>` of `machines.json`."""
        return name.removeprefix("g")


def lossless(case: Case) -> LosslessCase:
    """The case as one of a lossless grid.

    Raises:
        InputError: it has the models of a detailed plant instead.
    """
    if not isinstance(case, LosslessCase):
        raise InputError(f"case {case.id}", "schema", "has no lossless network, which is needed here")
    return case
