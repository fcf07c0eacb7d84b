"""Instance: one DED problem on a case - costs, load forecasts, initial values; JSON on disk."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, Record, of_kind, read_record
from ded_bench.problem.case import Case
from ded_bench.problem.quantities import (
    MAX_POINTS,
    Array,
    Extended,
    Name,
    NonNegative,
    Number,
    Positive,
    as_array,
    check_whole_steps,
)

#: No grid in operation is further from its nominal frequency, Hz; whoever writes more means another quantity.
LARGEST_DEVIATION_HZ = 1.0
#: How far from a point of the grid of time secondary control may act, in steps.
BETWEEN = 1e-6


class LoadRamp(Record):
    """A load that ramps once: `initial + rate * clip(t - start, 0, duration)`, an injection in pu."""

    initial: Number
    start: NonNegative
    duration: NonNegative
    rate: Number

    def at(self, t: Array) -> Array:
        """Injection in pu at times `t` in s (any shape)."""
        return np.asarray(self.initial + self.rate * np.clip(t - self.start, 0.0, self.duration))

    @property
    def kinks(self) -> tuple[float, ...]:
        """Times in s at which the injection changes its slope; they may lie beyond the horizon."""
        return (self.start, self.start + self.duration) if self.rate and self.duration else ()


_Points = Annotated[
    tuple[Annotated[tuple[NonNegative, Number], Field(strict=False)], ...],
    Field(strict=False, min_length=2, max_length=MAX_POINTS),
]


class LoadPoints(Fingerprinted):
    """A load by its injections in pu at times in s, linear between them (instance/2)."""

    points: Annotated[Array, as_array(_Points)]  # (n, 2)

    @model_validator(mode="after")
    def _increasing(self) -> LoadPoints:
        if self.points[0, 0] != 0:
            raise ValueError("points: must start at t = 0")
        if not (np.diff(self.points[:, 0]) > 0).all():
            raise ValueError("points: times must increase strictly")
        return self

    def at(self, t: Array) -> Array:
        """Injection in pu at times `t` in s (any shape), up to the last point."""
        return np.asarray(np.interp(t, *self.points.T))

    @property
    def kinks(self) -> tuple[float, ...]:
        """Times in s at which the injection may change its slope."""
        return tuple(self.points[1:-1, 0].tolist())


Load = Annotated[
    LoadRamp | LoadPoints,
    of_kind(lambda value: LoadPoints if "points" in value else LoadRamp, LoadRamp, LoadPoints),
]


class AgcState(Extended):
    """Secondary control at t = 0: what it holds, the integral of the mean frequency, when it acts next."""

    held_pu: Number = 0.0
    integral_rad: Number = 0.0
    next_s: NonNegative | None = None  # None: after a whole period


class Initial(Extended):
    """State at t = 0, by generator: set-point in pu, frequency deviation in rad/s, angle in rad.

    Without angles (always in instance/1) they are those of the power flow. On an island angles are relative
    to their inertia-weighted mean, and turbines' powers (pu) and secondary control may be given, too.
    """

    power: dict[Name, Number]
    omega: dict[Name, Number]
    theta: dict[Name, Number] | None = None
    mechanical: dict[Name, Number] | None = None
    agc: AgcState | None = None

    @property
    def measured(self) -> str | None:
        """The first field given beyond powers and frequencies; None: it starts from an equilibrium."""
        return next((n for n in ("theta", "mechanical", "agc") if getattr(self, n) is not None), None)


@dataclass(frozen=True, eq=False)
class State:
    """Where the generators are at an instant, as a planner is told; it need not be an equilibrium.

    Without angles it is the equilibrium of its powers, but for the frequencies.
    """

    theta: Array | None  # (n_gen,), rad, relative to the slack; on an island to the inertia-weighted mean
    omega: Array  # (n_gen,), rad/s, deviation from nominal
    p_gen: Array  # (n_gen,), pu: set-points
    mechanical: Array | None = None  # (n_gen,), pu: turbines' powers, where they are not the set-points
    agc: AgcState | None = None

    def initial(self, case: Case) -> Initial:
        """The state at t = 0 of an instance that starts here (instance/2)."""
        arrays = {
            "power": self.p_gen,
            "omega": self.omega,
            "theta": self.theta,
            "mechanical": self.mechanical,
        }
        by_name = {
            name: dict(zip(case.generators, values.tolist(), strict=True))
            for name, values in arrays.items()
            if values is not None
        }
        return Initial.model_construct(None, agc=self.agc, **by_name)


class Instance(Fingerprinted):
    """One DED problem; angles at t = 0 that it does not give are those of the plant's equilibrium."""

    schema_: Literal["ded-bench/instance/1", "ded-bench/instance/2"] = Field(alias="schema")
    id: Name
    case: Name
    seed: int | tuple[int, ...]
    horizon_s: Positive
    dt_s: Positive
    cost: dict[Name, NonNegative]  # of what `Case.priced` names, per pu and point of time
    load: dict[Name, Load]  # by bus
    initial: Initial

    @field_validator("seed", mode="after")
    @classmethod
    def _plain_seed(cls, seed: int | tuple[int, ...]) -> int | tuple[int, ...]:
        if any(part < 0 for part in (seed if isinstance(seed, tuple) else (seed,))):
            raise ValueError("must not be negative")
        return seed

    @model_validator(mode="after")
    def _consistent(self) -> Instance:
        check_whole_steps("horizon_s", self.horizon_s, self.dt_s)
        second = self.schema_ == "ded-bench/instance/2"
        newer = {"theta", "mechanical", "agc"} & self.initial.model_fields_set
        if newer and not second:
            raise ValueError(f"initial.{max(newer)}: needs schema ded-bench/instance/2")
        for bus, load in self.load.items():
            if isinstance(load, LoadPoints):
                if not second:
                    raise ValueError(f"load.{bus}.points: needs schema ded-bench/instance/2")
                if load.points[-1, 0] < self.horizon_s:
                    raise ValueError(f"load.{bus}.points: must reach the horizon")
        return self

    @staticmethod
    def load_file(path: str | Path, case: Case | None = None) -> tuple[Instance, Case]:
        """Read an instance and the case it belongs to.

        The case is the one given, else `../case.json` beside the instance's folder, else a shipped
        case of that name.

        Raises:
            InputError: a file is missing or wrong, or instance and case do not fit together.
        """
        instance = read_record(Instance, path)
        if case is None:
            beside = Path(path).resolve().parent.parent / "case.json"
            case = Case.load(beside) if beside.is_file() else None
            if case is None or case.id != instance.case:
                case = Case.load(instance.case)
        instance.check_case(case, path)
        return instance, case

    def check_case(self, case: Case, source: str | Path = "") -> None:
        """Raise InputError unless this instance names exactly the generators and loads of `case`."""
        source = source or f"instance {self.id}"
        if self.case != case.id:
            raise InputError(source, "case", f"is for case {self.case!r}, not {case.id!r}")
        wanted: dict[str, tuple[Mapping[str, object], tuple[str, ...]]] = {
            "cost": (self.cost, case.priced),
            "load": (self.load, case.loads),
        }
        for name in ("power", "omega", "theta", "mechanical"):
            if (values := getattr(self.initial, name)) is not None:
                wanted[f"initial.{name}"] = (values, case.generators)
        for field, (given, buses) in wanted.items():
            if missing := [bus for bus in buses if bus not in given]:
                raise InputError(source, f"{field}.{missing[0]}", "field required")
            if unknown := [bus for bus in given if bus not in buses]:
                raise InputError(source, f"{field}.{unknown[0]}", f"no such bus here in case {case.id}")
        if self.initial.mechanical is not None and case.slack is not None:
            raise InputError(source, "initial.mechanical", f"case {case.id} is no island")
        if (agc := self.initial.agc) is not None:
            if case.agc is None:
                raise InputError(source, "initial.agc", f"case {case.id} has no secondary control")
            if (agc.next_s or 0.0) > case.agc.period_s:
                raise InputError(source, "initial.agc.next_s", f"is beyond {case.agc.period_s:g} s, a period")
        if case.agc is not None:
            first = (agc and agc.next_s) or 0.0
            for field, time in (("dt_s", case.agc.period_s), ("initial.agc.next_s", first)):
                if abs(time - round(time / self.dt_s) * self.dt_s) > BETWEEN * self.dt_s:
                    raise InputError(source, field, f"AGC acts at {time:g} s, between points of time")

    @functools.cached_property
    def steps(self) -> int:
        """Number of time steps; the grid has one point more."""
        return round(self.horizon_s / self.dt_s)

    @functools.cached_property
    def grid(self) -> Array:
        """Times t_k = k dt, shape (steps + 1,), s."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.dt_s

    @functools.cached_property
    def kinks(self) -> Array:
        """Times at which a load may change its slope, beside 0 and the horizon, ascending, (n_kinks,), s."""
        inner = {t for load in self.load.values() for t in load.kinks if t < self.horizon_s}
        return np.array(sorted({0.0, self.horizon_s} | inner))

    def until(self, horizon_s: float) -> Instance:
        """The same with a horizon of about so many seconds, a whole number of steps, if its own is longer."""
        steps = round(horizon_s / self.dt_s)
        return self if steps >= self.steps else self.model_copy(update={"horizon_s": steps * self.dt_s})

    def p_load(self, case: Case, t: Array | None = None) -> Array:
        """Load injections at times `t` (default: the grid), shape (n_t, n_load), pu."""
        times = self.grid if t is None else t
        return np.stack([self.load[bus].at(times) for bus in case.loads], axis=-1)

    def p_initial(self, case: Case) -> Array:
        """Generator power at t = 0 (the paper's P_0), shape (n_gen,), pu."""
        return np.array([self.initial.power[g] for g in case.generators])

    def omega_initial(self, case: Case) -> Array:
        """Frequency deviation at t = 0, shape (n_gen,), rad/s."""
        return np.array([self.initial.omega[g] for g in case.generators])

    def theta_initial(self, case: Case) -> Array | None:
        """Given angles at t = 0 (see `State.theta`), shape (n_gen,), rad; None: the power flow's."""
        given = self.initial.theta
        return None if given is None else np.array([given[g] for g in case.generators])

    def mechanical_initial(self, case: Case) -> Array | None:
        """Given powers of the turbines at t = 0, shape (n_gen,), pu; None: the set-points."""
        given = self.initial.mechanical
        return None if given is None else np.array([given[g] for g in case.generators])

    def cost_gen(self, case: Case) -> Array:
        """Generator costs c_i per pu and point of time, shape (n_gen,)."""
        return np.array([self.cost[g] for g in case.generators])

    def cost_slack(self, case: Case) -> float:
        """Cost c_s of one pu at the slack bus, of either sign; 0 on an island, which has none."""
        return 0.0 if case.slack is None else self.cost[case.slack]


def check_plausible(case: Case, instance: Instance, source: str | Path) -> None:
    """Check signs and units of an instance's loads and frequencies.

    Raises:
        InputError: a load injects where the case's draws or the other way round, or a frequency deviation
            is beyond LARGEST_DEVIATION_HZ.
    """
    initial = instance.p_load(case, np.zeros(1))[0]
    for bus, value, nominal in zip(case.loads, initial, case.load_nominal, strict=True):
        if value * nominal < 0:
            does = "draws power, which is negative" if nominal < 0 else "feeds in, which is positive"
            problem = f"{value:g} pu has the wrong sign: in case {case.id} this bus {does}"
            raise InputError(source, f"load.{bus}", problem)
    largest = 2 * np.pi * LARGEST_DEVIATION_HZ
    for bus, value in instance.initial.omega.items():
        if abs(value) > largest:
            problem = (
                f"{value:g} rad/s is {value / (2 * np.pi):.3g} Hz from the nominal frequency; "
                "give the deviation in rad/s, not the frequency in Hz"
            )
            raise InputError(source, f"initial.omega.{bus}", problem)


def load_instances(paths: Sequence[str | Path], case: Case | None = None) -> tuple[list[Instance], Case]:
    """Read several instances of one case.

    Raises:
        InputError: no file given, a file is wrong, two have the same id, or the cases differ.
    """
    instances: dict[str, Instance] = {}
    given = case
    for path in paths:
        instance, own_case = Instance.load_file(path, given)
        if case is not None and own_case != case:
            raise InputError(path, "case", "instances of one run must share one case")
        if instance.id in instances:
            raise InputError(path, "id", f"{instance.id} was already given by another file")
        case = own_case
        instances[instance.id] = instance
    if case is None:
        raise InputError("instances", "", "no instance was given")
    return list(instances.values()), case
