"""Case: buses, lines, machines and limits of one grid, and the ranges its instances are drawn from."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, Record, read_record

Array = NDArray[np.float64]
#: Numbers beyond these are typing errors or in other units; within them no product overflows.
SMALLEST, LARGEST = 1e-9, 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Magnitude = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Probability = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Range = tuple[Number, Number]
#: Knots of a case that names no number of its own.
KNOTS = 50

REPOSITORY = Path(__file__).resolve().parents[2]
#: Cases that come with the suite: beside a checkout, or inside an installed package.
SHIPPED_CASES = next(
    (p for p in (REPOSITORY / "problems", REPOSITORY / "ded_bench" / "_problems") if p.is_dir()),
    REPOSITORY / "problems",
)


class Extended(Record):
    """A record that a later schema extends: what is not given is not written, as before."""

    @model_serializer(mode="wrap")
    def _given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in write(self).items() if value is not None}


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


class Machine(Extended):
    """Inertia m (s² pu/rad), damping d (s pu/rad), power limits in pu and ramp limit of one generator."""

    m: Magnitude
    d: NonNegative
    p_nominal: Number
    p_min: Number
    p_max: Number
    ramp_pu_per_s: Magnitude | None = None  # case/2; else the case's

    @model_validator(mode="after")
    def _ordered(self) -> Machine:
        if not self.p_min < self.p_max:
            raise ValueError("p_min must be below p_max")
        return self


class Regime(Record):
    """Limits of one operating regime: |omega| at every generator stays within `omega_hz`."""

    omega_hz: Magnitude


class Sampling(Extended):
    """Ranges of the sampler (paper, Table III); uniform unless said otherwise.

    Loads ramp at rates of either sign whose size is in `rate_pu_per_s`, or, in case/2, in
    `rate_relative_per_s` times the size of the load's nominal value.
    """

    horizon_s: Positive
    dt_s: Positive
    load_relative: NonNegative
    start_s: Range
    duration_s: Range
    rate_pu_per_s: Range | None = None
    rate_relative_per_s: Range | None = None  # case/2
    rate_zero_probability: Probability
    perturbation: Range
    omega_rad_per_s: Range
    cost: Range

    @model_validator(mode="after")
    def _ordered(self) -> Sampling:
        for name, value in self:
            if isinstance(value, tuple) and value[0] > value[1]:
                raise ValueError(f"{name}: lower end above upper end")
            positive = name in ("start_s", "duration_s", "rate_pu_per_s", "rate_relative_per_s", "cost")
            if positive and value is not None and value[0] < 0:
                raise ValueError(f"{name}: must not be negative")
        if (self.rate_pu_per_s is None) == (self.rate_relative_per_s is None):
            raise ValueError("exactly one of rate_pu_per_s and rate_relative_per_s is needed")
        return self


class Case(Fingerprinted, Extended):
    """One grid. Buses keep the file's order; generators and loads are named by their bus."""

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
    def _consistent(self) -> Case:
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
        for line in self.lines:
            if line.from_bus == line.to_bus or {line.from_bus, line.to_bus} - set(names):
                raise ValueError(f"lines: {line.from_bus}-{line.to_bus} does not join two known buses")
        self._check_connected(set(names))
        self._check_schema()
        return self

    def _check_schema(self) -> None:
        given = {*self.model_fields_set, *(f"sampling.{name}" for name in self.sampling.model_fields_set)}
        given |= {f"machines.{bus}.{n}" for bus, m in self.machines.items() for n in m.model_fields_set}
        newer = {"source", "knots", "sampling.rate_relative_per_s"}
        newer |= {f"machines.{bus}.ramp_pu_per_s" for bus in self.machines}
        if self.schema_ == "ded-bench/case/1" and given & newer:
            raise ValueError(f"{min(given & newer)}: belongs to schema ded-bench/case/2")

    def _check_connected(self, names: set[str]) -> None:
        reached = {self.slack}
        for _ in names:
            for line in self.lines:
                if reached & {line.from_bus, line.to_bus}:
                    reached |= {line.from_bus, line.to_bus}
        if names - reached:
            raise ValueError(f"lines: bus {min(names - reached)} is not connected to the slack bus")

    @staticmethod
    def load(name_or_path: str | Path) -> Case:
        """Read a case by the name of a shipped one, its folder, or its case.json.

        A folder that holds no case, such as results named after theirs, does not hide the shipped case.

        Raises:
            InputError: there is no such case, or its file is wrong.
        """
        return read_record(Case, case_file(name_or_path))

    @property
    def plant_name(self) -> str:
        """Name of the plant that it is simulated on unless told otherwise (`plants.plant.PLANTS`)."""
        return "lossless"

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
    def p_min(self) -> Array:
        """Lower generator limits, shape (n_gen,), pu."""
        return np.array([self.machines[g].p_min for g in self.generators])

    @functools.cached_property
    def p_max(self) -> Array:
        """Upper generator limits, shape (n_gen,), pu."""
        return np.array([self.machines[g].p_max for g in self.generators])

    @functools.cached_property
    def p_nominal(self) -> Array:
        """Nominal generator power, shape (n_gen,), pu."""
        return np.array([self.machines[g].p_nominal for g in self.generators])

    @functools.cached_property
    def load_nominal(self) -> Array:
        """Nominal load injections, shape (n_load,), pu (negative)."""
        return np.array([bus.p_nominal for bus in self.buses if bus.kind == "load"], dtype=float)

    @functools.cached_property
    def ramp(self) -> Array:
        """Ramp limits of the generators, shape (n_gen,), pu/s."""
        own = [self.machines[g].ramp_pu_per_s for g in self.generators]
        return np.array([self.ramp_pu_per_s if ramp is None else ramp for ramp in own])

    @functools.cached_property
    def load_rate(self) -> Array:
        """Least and largest size of a load's ramp rate in the sampler, shape (2, n_load), pu/s."""
        if self.sampling.rate_relative_per_s is not None:
            return np.outer(self.sampling.rate_relative_per_s, np.abs(self.load_nominal))
        return np.repeat(np.array([self.sampling.rate_pu_per_s], dtype=float).T, len(self.loads), axis=1)

    @property
    def n_knots(self) -> int:
        """Number of knots of policies and knot methods, chosen from the fastest mode (`knots` in case/2)."""
        return KNOTS if self.knots is None else self.knots

    def knot_times(self, horizon_s: float) -> Array:
        """Equidistant times from 0 to the horizon, shape (n_knots,), s."""
        return np.linspace(0.0, horizon_s, self.n_knots)

    def omega_bound(self, regime: str) -> float:
        """Bound on |omega| in rad/s.

        Raises:
            InputError: the case has no such regime.
        """
        self.check_regimes([regime])
        return 2 * np.pi * self.regimes[regime].omega_hz

    def check_regimes(self, regimes: Iterable[str]) -> None:
        """Raise InputError unless the case knows every one of the regimes."""
        for regime in regimes:
            if regime not in self.regimes:
                raise InputError(
                    f"case {self.id}",
                    "regime",
                    f"unknown regime {regime!r} (known: {', '.join(self.regimes)})",
                )


def case_file(name_or_path: str | Path) -> Path:
    """The file of a case (see `Case.load`); InputError if there is no such case."""
    path = Path(name_or_path)
    own, shipped = path / "case.json", SHIPPED_CASES / path / "case.json"
    if own.is_file() or (path.is_dir() and not shipped.is_file()):
        return own
    if shipped.is_file() and not path.is_file():
        return shipped
    if not path.exists():
        known = ", ".join(sorted(p.parent.name for p in SHIPPED_CASES.glob("*/case.json")))
        raise InputError(name_or_path, "", f"no such case (shipped: {known})")
    return path
