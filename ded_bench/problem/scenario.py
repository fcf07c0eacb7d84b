"""Scenario: minutes of operation of a case - costs, what the loads do and what is announced; JSON on disk."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, Record, read_record
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Initial, Instance, LoadPoints, LoadRamp
from ded_bench.problem.quantities import (
    MAX_POINTS,
    Array,
    Name,
    NonNegative,
    Number,
    Positive,
    as_array,
    check_whole_steps,
)

#: Of forecasts. `announced`: ramps as announced; `perfect`: what will be; `worse`: announcements four times
#: as wrong; `persistence`: loads stay as they are.
QUALITIES = ("announced", "perfect", "worse", "persistence")


class ScenarioRamp(Record):
    """One ramp of a load, and what was announced of it in advance: both values, or neither."""

    start: NonNegative  # s
    duration: NonNegative  # s
    rate: Number  # pu/s
    announced_start: NonNegative | None
    announced_rate: Number | None

    @model_validator(mode="after")
    def _announced_whole(self) -> ScenarioRamp:
        if (self.announced_start is None) != (self.announced_rate is None):
            raise ValueError("announced_start and announced_rate: both or neither")
        return self

    @property
    def end(self) -> float:
        """When the ramp ends, s."""
        return self.start + self.duration


_Values = Annotated[tuple[Number, ...], Field(strict=False, min_length=2, max_length=MAX_POINTS)]


class Fluctuation(Fingerprinted):
    """What a load does beside its ramps: pu every `step_s` from t = 0, linear between.

    Forecasts let its present value decay by exp(-t / decay_s).
    """

    step_s: Positive
    values: Annotated[Array, as_array(_Values)]
    decay_s: Positive

    @functools.cached_property
    def times(self) -> Array:
        """Times of the values, s."""
        return np.arange(len(self.values), dtype=np.float64) * self.step_s


class ScenarioLoad(Record):
    """A load that ramps several times and fluctuates; an injection in pu."""

    initial: Number
    ramps: Annotated[tuple[ScenarioRamp, ...], Field(max_length=MAX_POINTS)]
    fluctuation: Fluctuation

    def at(self, t: Array) -> Array:
        """Injection in pu at times `t` in s (any shape)."""
        ramped = sum(ramp.rate * np.clip(t - ramp.start, 0.0, ramp.duration) for ramp in self.ramps)
        return np.asarray(self.initial + ramped + self.fluctuation_at(t))

    def fluctuation_at(self, t: Array) -> Array:
        """Fluctuation in pu at times `t` in s (any shape)."""
        return np.asarray(np.interp(t, self.fluctuation.times, self.fluctuation.values))


class Scenario(Fingerprinted):
    """Operation of one case for `duration_s`; the loads go on for a horizon of the case beyond it."""

    schema_: Literal["ded-bench/scenario/1"] = Field(alias="schema")
    id: Name
    case: Name
    seed: tuple[Annotated[int, Field(ge=0)], ...]
    duration_s: Positive
    dt_s: Positive
    cost: dict[Name, NonNegative]
    initial: Initial
    load: dict[Name, ScenarioLoad]

    @model_validator(mode="after")
    def _whole_steps(self) -> Scenario:
        check_whole_steps("duration_s", self.duration_s, self.dt_s)
        if given := self.initial.measured:
            raise ValueError(f"initial.{given}: a scenario starts from the power flow")
        return self

    def check_case(self, case: Case, source: str | Path = "") -> None:
        """Raise InputError unless this names exactly the buses of `case` and its loads last long enough."""
        source = source or f"scenario {self.id}"
        horizon_s = case.sampling.horizon_s
        steps = horizon_s / self.dt_s
        if abs(steps - round(steps)) > 1e-9 * steps or round(steps) < 1:
            raise InputError(source, "dt_s", f"must divide the case's horizon of {horizon_s:g} s")
        self.snapshot(case, 0.0).check_case(case, source)
        needed = self.duration_s + horizon_s
        for bus, load in self.load.items():
            if load.fluctuation.times[-1] < needed - 1e-9:
                problem = f"must last for {needed:g} s, duration and horizon"
                raise InputError(source, f"load.{bus}.fluctuation.values", problem)

    @functools.cached_property
    def steps(self) -> int:
        """Number of time steps of the duration; the grid has one point more."""
        return round(self.duration_s / self.dt_s)

    @functools.cached_property
    def grid(self) -> Array:
        """Times t_k = k dt, shape (steps + 1,), s."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.dt_s

    @functools.cached_property
    def ramps(self) -> Array:
        """Start, duration, rate, announced start and rate, (5, n_load, most ramps); unannounced: never."""
        found = np.zeros((len(self.load), max(len(load.ramps) for load in self.load.values()), 5))
        for own, load in zip(found, self.load.values(), strict=True):
            for i, r in enumerate(load.ramps):
                told = np.inf if r.announced_start is None else r.announced_start
                own[i] = r.start, r.duration, r.rate, told, r.announced_rate or 0.0
        return np.moveaxis(found, 2, 0)

    @functools.cached_property
    def fluctuations(self) -> tuple[Array, Array, Array, Array]:
        """Initial loads, pu, steps and decays, s, (n_load, 1); values, (n_load, most), pu: the last stays."""
        given = [load.fluctuation for load in self.load.values()]
        most = max(len(own.values) for own in given)
        values = [np.pad(own.values, (0, most - len(own.values)), mode="edge") for own in given]
        initial = np.array([load.initial for load in self.load.values()])[:, None]
        step, decay = np.array([(own.step_s, own.decay_s) for own in given]).T[:, :, None]
        return initial, step, decay, np.array(values)

    def p_load(self, case: Case, t: Array | None = None) -> Array:
        """True load injections at times `t` (default: the grid), shape (n_t, n_load), pu."""
        if t is None:
            return self._on_grid.take([*map(list(self.load).index, case.loads)], axis=1)
        return np.stack([self.load[bus].at(t) for bus in case.loads], axis=-1)

    @functools.cached_property
    def _on_grid(self) -> Array:
        return np.stack([load.at(self.grid) for load in self.load.values()], axis=-1)

    def snapshot(self, case: Case, t: float) -> Instance:
        """An instance whose loads stay as they are at time `t`: the initial power is the scenario's."""
        load: dict[str, LoadRamp | LoadPoints] = {
            bus: LoadRamp(initial=float(load.at(np.array(t))), start=0.0, duration=0.0, rate=0.0)
            for bus, load in self.load.items()
        }
        return Instance(
            schema_="ded-bench/instance/1",
            id=self.id,
            case=self.case,
            seed=self.seed,
            horizon_s=case.sampling.horizon_s,
            dt_s=self.dt_s,
            cost=self.cost,
            load=load,
            initial=self.initial,
        )


def load_scenarios(paths: Sequence[str | Path], case: Case) -> list[Scenario]:
    """Read several scenarios of one case.

    Raises:
        InputError: no file given, a file is missing, wrong or of another case, or two have the same id.
    """
    found: dict[str, Scenario] = {}
    for path in paths:
        scenario = read_record(Scenario, path)
        scenario.check_case(case, path)
        if scenario.id in found:
            raise InputError(path, "id", f"{scenario.id} was already given by another file")
        found[scenario.id] = scenario
    if not found:
        raise InputError("scenarios", "", "no scenario was given")
    return list(found.values())
