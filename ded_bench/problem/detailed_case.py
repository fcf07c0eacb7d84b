"""Cases of a grid with full machine models (case/3): plant, machines' limits, loads, transfers."""

from __future__ import annotations

import functools
import hashlib
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ded_bench.files.strict import Record, of_kind
from ded_bench.problem.case import Case, Sampling
from ded_bench.problem.limits import Agc, IslandRegime, Regime, ScheduledMachine, Transfer
from ded_bench.problem.quantities import LARGEST, Array, Magnitude, Name, check_whole_steps


class PlantChoice(Record):
    """What is simulated: an infinite machine at the slack bus, or an island with secondary control."""

    kind: Literal["detailed"]
    slack: Literal["infinite", "island"]
    agc: Agc | None

    @model_validator(mode="after")
    def _controlled(self) -> PlantChoice:
        if self.agc is not None and self.slack != "island":
            raise ValueError("agc: needs an island")
        return self


AnyRegime = Annotated[
    Regime | IslandRegime,
    of_kind(lambda value: Regime if "omega_hz" in value else IslandRegime, Regime, IslandRegime),
]


class DetailedCase(Case):
    """A grid whose network and machine models stand in `network.json` and `machines.json` beside it."""

    plant_name, needs_grid = "detailed", True
    usual_knots = 61  # one a second in a minute
    schema_: Literal["ded-bench/case/3"] = Field(alias="schema")
    id: Name
    source: str | dict[Name, str] | None = None
    f0_hz: Magnitude
    plant: PlantChoice
    machines: Annotated[dict[Name, ScheduledMachine], Field(min_length=1)]
    loads_: Annotated[
        dict[Name, Annotated[float, Field(ge=-LARGEST, lt=0)]], Field(alias="loads", min_length=1)
    ]
    transfers_: Annotated[tuple[Transfer, ...] | None, Field(alias="transfers")] = None
    ramp_pu_per_s: Magnitude
    regimes: dict[Name, AnyRegime]
    sampling: Sampling
    knots: Annotated[int, Field(ge=2, le=100_000)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> DetailedCase:
        kind, names = (IslandRegime, "mean_hz, relative_hz, end_hz") if self.island else (Regime, "omega_hz")
        if not self.regimes:
            raise ValueError("regimes: at least one regime is needed")
        for name, regime in self.regimes.items():
            if not isinstance(regime, kind):
                raise ValueError(f"regimes.{name}: must have {names}")
        named = {"plant.agc.participation": set(self.agc.participation if self.agc else ())}
        for transfer in self.transfers:
            named[f"transfers.{transfer.name}"] = set(transfer.machines)
            if unknown := set(transfer.loads) - set(self.loads):
                raise ValueError(f"transfers.{transfer.name}: there is no load {min(unknown)}")
        if self.agc is not None:
            check_whole_steps("plant.agc.period_s", self.agc.period_s, self.sampling.dt_s)
        for field, machines in named.items():
            if unknown := machines - set(self.machines):
                raise ValueError(f"{field}: there is no machine {min(unknown)}")
        return self

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with the case, its network or its machines."""
        parts = [self.model_dump_json(by_alias=True)]
        parts += [] if self._grid is None else [self._grid.fingerprint]
        return hashlib.sha256("".join(parts).encode()).hexdigest()[:12]

    @property
    def island(self) -> bool:
        """Whether there is no infinite machine: every machine is scheduled."""
        return self.plant.slack == "island"

    @property
    def slack(self) -> str | None:
        """The infinite machine; None on an island."""
        return None if self.island else self.detailed.slack

    @functools.cached_property
    def generators(self) -> tuple[str, ...]:
        """Scheduled machines, in the order of case.json."""
        return tuple(name for name in self.machines if self.island or name != self.slack)

    @functools.cached_property
    def loads(self) -> tuple[str, ...]:
        """Buses of the loads."""
        return tuple(self.loads_)

    @functools.cached_property
    def load_nominal(self) -> Array:
        """Nominal load injections, shape (n_load,), pu (negative)."""
        return np.array(list(self.loads_.values()))

    @property
    def agc(self) -> Agc | None:
        """Secondary control; None: there is none."""
        return self.plant.agc

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """Limits on what groups of machines deliver."""
        return self.transfers_ or ()

    @functools.cached_property
    def inertia(self) -> Array:
        """M = 2 h of the generators on 100 MVA, shape (n_gen,), s."""
        return np.array([self.detailed.machines[name].inertia for name in self.generators])

    @property
    def n_bus(self) -> int:
        """Number of buses."""
        return len(self.detailed.network.buses)
