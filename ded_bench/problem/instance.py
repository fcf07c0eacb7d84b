"""Instance: one DED problem on a case - costs, load forecasts, initial values; JSON on disk."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record
from ded_bench.problem.case import Array, Case, Name, NonNegative, Number, Positive

if TYPE_CHECKING:
    import pandas as pd

MAX_STEPS = 1_000_000


class LoadRamp(Record):
    """A load that ramps once: `initial + rate * clip(t - start, 0, duration)`, an injection in pu."""

    initial: Number
    start: NonNegative
    duration: NonNegative
    rate: Number

    def at(self, t: Array) -> Array:
        """Injection in pu at times `t` in s (any shape)."""
        into = np.minimum(np.maximum(t - self.start, 0.0), self.duration)  # np.clip takes twice as long
        return np.asarray(self.initial + self.rate * into)


class Initial(Record):
    """State at t = 0: generator power in pu and frequency deviation in rad/s, by bus."""

    power: dict[Name, Number]
    omega: dict[Name, Number]


class Instance(Record):
    """One DED problem. Angles at t = 0 follow from the power flow (see `truth.swing`)."""

    schema_: Literal["ded-bench/instance/1"] = Field(alias="schema")
    id: Name
    case: Name
    seed: int | tuple[int, ...]
    horizon_s: Positive
    dt_s: Positive
    cost: dict[Name, NonNegative]
    load: dict[Name, LoadRamp]
    initial: Initial

    @field_validator("seed", mode="after")
    @classmethod
    def _plain_seed(cls, seed: int | tuple[int, ...], info: ValidationInfo) -> int | tuple[int, ...]:
        if any(part < 0 for part in (seed if isinstance(seed, tuple) else (seed,))):
            raise ValueError("must not be negative")
        return seed

    @model_validator(mode="after")
    def _whole_steps(self) -> Instance:
        steps = self.horizon_s / self.dt_s
        if steps > MAX_STEPS:  # first, since the quotient may be infinite
            raise ValueError(f"dt_s: more than {MAX_STEPS} time steps")
        if abs(steps - round(steps)) > 1e-9 * steps or round(steps) < 1:
            raise ValueError("horizon_s: must be a whole multiple of dt_s")
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
        """Raise InputError unless this instance names exactly the buses of `case`."""
        source = source or f"instance {self.id}"
        if self.case != case.id:
            raise InputError(source, "case", f"is for case {self.case!r}, not {case.id!r}")
        wanted: dict[str, tuple[Mapping[str, object], tuple[str, ...]]] = {
            "cost": (self.cost, (case.slack, *case.generators)),
            "load": (self.load, case.loads),
            "initial.power": (self.initial.power, case.generators),
            "initial.omega": (self.initial.omega, case.generators),
        }
        for field, (given, buses) in wanted.items():
            if missing := [bus for bus in buses if bus not in given]:
                raise InputError(source, f"{field}.{missing[0]}", "field required")
            if unknown := [bus for bus in given if bus not in buses]:
                raise InputError(source, f"{field}.{unknown[0]}", f"no such bus here in case {case.id}")

    @functools.cached_property
    def steps(self) -> int:
        """Number of time steps; the grid has one point more."""
        return round(self.horizon_s / self.dt_s)

    @functools.cached_property
    def grid(self) -> Array:
        """Times t_k = k dt, shape (steps + 1,), s."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.dt_s

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

    def cost_gen(self, case: Case) -> Array:
        """Generator costs c_i, shape (n_gen,)."""
        return np.array([self.cost[g] for g in case.generators])

    def cost_slack(self, case: Case) -> float:
        """Cost c_s of one pu at the slack bus, of either sign."""
        return self.cost[case.slack]

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when anything in the instance does."""
        return hashlib.sha256(self.model_dump_json(by_alias=True).encode()).hexdigest()[:12]

    def __eq__(self, other: object) -> bool:
        """Equal content; cached arrays do not count."""
        return isinstance(other, Instance) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        """Equal instances have equal hashes."""
        return hash(self.fingerprint)


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


def instances_frame(instances: Sequence[Instance]) -> pd.DataFrame:
    """One row per instance with everything that its file says.

    Columns: `id, case, seed, horizon_s, dt_s` (the seed's parts joined by spaces), then by bus
    `cost_<bus>`, `load_<bus>_initial` (pu), `_start` (s), `_duration` (s), `_rate` (pu/s), `P0_<bus>`
    (initial power, pu) and `omega0_<bus>` (initial frequency deviation, rad/s).
    """
    import pandas as pd  # here only: loading instances does without it

    rows = []
    for instance in instances:
        seed = instance.seed if isinstance(instance.seed, tuple) else (instance.seed,)
        row: dict[str, Any] = {"id": instance.id, "case": instance.case, "seed": " ".join(map(str, seed))}
        row |= {"horizon_s": instance.horizon_s, "dt_s": instance.dt_s}
        row |= {f"cost_{bus}": value for bus, value in instance.cost.items()}
        for bus, ramp in instance.load.items():
            row |= {f"load_{bus}_{name}": value for name, value in ramp}
        row |= {f"P0_{bus}": value for bus, value in instance.initial.power.items()}
        row |= {f"omega0_{bus}": value for bus, value in instance.initial.omega.items()}
        rows.append(row)
    return pd.DataFrame(rows)
