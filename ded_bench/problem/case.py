"""Case: one grid, its limits, and the ranges its instances are drawn from; its file, and those beside it."""

from __future__ import annotations

import abc
import functools
import importlib
import json
import pickle
import pkgutil
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import PrivateAttr, model_validator

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Fingerprinted, parse_record, read_text
from ded_bench.problem.grid_files import GRID_FILES, MACHINES_FILE, NETWORK_FILE, GridFiles, load_grid_files
from ded_bench.problem.limits import Agc, Bounds, IslandRegime, Regime, Transfer
from ded_bench.problem.quantities import Array as Array
from ded_bench.problem.quantities import (
    Extended,
    NonNegative,
    Positive,
    Probability,
    Range,
    check_whole_steps,
)
from ded_bench.problem.quantities import Indices as Indices

#: Records of a case's file by its schema: `module:class`.
SCHEMAS = {
    "ded-bench/case/1": "ded_bench.problem.lossless_case:LosslessCase",
    "ded-bench/case/2": "ded_bench.problem.lossless_case:LosslessCase",
    "ded-bench/case/3": "ded_bench.problem.detailed_case:DetailedCase",
}

REPOSITORY = Path(__file__).resolve().parents[2]
#: Cases that come with the suite: beside a checkout, or inside an installed package.
SHIPPED_CASES = next(
    (p for p in (REPOSITORY / "problems", REPOSITORY / "ded_bench" / "_problems") if p.is_dir()),
    REPOSITORY / "problems",
)


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
        check_whole_steps("horizon_s", self.horizon_s, self.dt_s)
        return self


class Case(Fingerprinted, Extended):
    """What the records of all schemas share.

    Generators are what a schedule gives set-points to; loads are named by their bus. Fields of all are `id`,
    `f0_hz`, `machines` by generator, `ramp_pu_per_s`, `regimes`, `sampling` and `knots`.
    """

    if TYPE_CHECKING:  # each record declares its fields in the order of its file, as its fingerprint needs it
        schema_: str
        id: str
        f0_hz: float
        machines: Mapping[str, Any]
        ramp_pu_per_s: float
        regimes: Mapping[str, Regime | IslandRegime]
        sampling: Sampling
        knots: int | None

    #: Knots of a case that names no number of its own.
    usual_knots: ClassVar[int]
    #: Name of the plant that it is simulated on unless told otherwise (`plants.plant.PLANTS`).
    plant_name: ClassVar[str]
    #: Whether it is nothing without the files of its grid beside it.
    needs_grid: ClassVar[bool] = False
    _grid: GridFiles | None = PrivateAttr(default=None)
    _folder: Path | None = PrivateAttr(default=None)

    @staticmethod
    def load(name_or_path: str | Path) -> Case:
        """Read a case by the name of a shipped one, its folder, or its case.json.

        A folder that holds no case, such as results named after theirs, does not hide the shipped case.
        `network.json` and `machines.json` beside it are read, too: case/3 needs them.

        Raises:
            InputError: there is no such case, or a file is missing or wrong.
        """
        path = case_file(name_or_path)
        text = read_text(path)
        case = parse_record(_record_of(text, path), text, path)
        case._folder = path.parent
        if case.needs_grid or all((path.parent / name).is_file() for name in GRID_FILES):
            case._grid = load_grid_files(path.parent, case.id, case.f0_hz)
            case._check_grid(case._grid, path.parent)
        return case

    def _check_grid(self, grid: GridFiles, folder: Path) -> None:
        """Raise InputError unless the files beside the case have its machines and loads."""
        named = {self.machine_of(name) for name in self.priced}
        if differing := named ^ set(grid.machines):
            where = "case.json" if differing & named else MACHINES_FILE
            raise InputError(folder / where, "machines", f"machine {min(differing)} stands here only")
        if unknown := set(self.loads) - {bus.id for bus in grid.network.buses}:
            raise InputError(folder / NETWORK_FILE, "buses", f"there is no bus {min(unknown)} of a load")

    @property
    def folder(self) -> Path:
        """Of its instances and scenarios: where it was read, else that of the shipped case of its name."""
        return self._folder or SHIPPED_CASES / self.id

    @property
    def place(self) -> str:
        """What `--case` finds it by, in a shell."""
        return self.id if self.folder.parent == SHIPPED_CASES else shlex.quote(str(self.folder))

    def __eq__(self, other: object) -> bool:
        """Equal content, also of the files beside the case."""
        return isinstance(other, Case) and super().__eq__(other) and self._grid == other._grid

    __hash__ = Fingerprinted.__hash__

    def __reduce__(self) -> tuple[Callable[[bytes], Case], tuple[bytes]]:
        """Pickled once, and read once where it arrives: every request to a worker names its case."""
        return _unpickled, (self._pickled,)

    @functools.cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps((type(self), self.__getstate__()))

    @property
    def detailed(self) -> GridFiles:
        """The AC network and the machines of the files beside the case.

        Raises:
            InputError: there are none.
        """
        if self._grid is None:
            problem = f"{NETWORK_FILE} and {MACHINES_FILE} are needed beside case.json"
            raise InputError(f"case {self.id}", "plant", problem)
        return self._grid

    @property
    @abc.abstractmethod
    def slack(self) -> str | None:
        """Name of what takes up every imbalance; None on an island."""

    @property
    @abc.abstractmethod
    def generators(self) -> tuple[str, ...]:
        """What a schedule gives set-points to (the paper's 𝒢, without the slack)."""

    @property
    @abc.abstractmethod
    def loads(self) -> tuple[str, ...]:
        """Buses of the loads (the paper's ℒ)."""

    @property
    @abc.abstractmethod
    def load_nominal(self) -> Array:
        """Nominal load injections, shape (n_load,), pu (negative, but for feed-ins of lossless cases)."""

    @property
    @abc.abstractmethod
    def inertia(self) -> Array:
        """Weights of the generators in the mean frequency, (n_gen,), s² pu/rad, or s of machine models."""

    @property
    @abc.abstractmethod
    def n_bus(self) -> int:
        """Number of buses."""

    @property
    def n_knots(self) -> int:
        """Number of knots of policies and knot methods (`knots` of the file)."""
        return self.usual_knots if self.knots is None else self.knots

    def machine_of(self, name: str) -> str:
        """Name in `machines.json` of a generator, or of the slack."""
        return name

    @property
    def agc(self) -> Agc | None:
        """Secondary control; None: there is none."""
        return None

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """Limits on what groups of machines deliver."""
        return ()

    def transfer_excess(self, p_set: Array, p_load: Array) -> Array:
        """What groups of machines deliver beyond their loads and their limit, shape (..., n_transfers), pu.

        Args:
            p_set: set-points, shape (..., n_gen), pu.
            p_load: load injections, shape (..., n_load), pu.
        """
        by_machine, by_load, limit = self.transfer_rows
        return np.asarray(p_set @ by_machine.T + p_load @ by_load.T - limit)

    @functools.cached_property
    def transfer_rows(self) -> tuple[Array, Array, Array]:
        """Coefficients of set-points and load injections, (n_transfers, n_gen or n_load), and limits, pu."""
        rows = [[g in t.machines for g in self.generators] for t in self.transfers]
        of_loads = [[bus in t.loads for bus in self.loads] for t in self.transfers]
        shapes = (-1, len(self.generators)), (-1, len(self.loads))
        by = [np.array(r, dtype=float).reshape(s) for r, s in zip((rows, of_loads), shapes, strict=True)]
        return by[0], by[1], np.array([t.max for t in self.transfers])

    @property
    def priced(self) -> tuple[str, ...]:
        """What an instance gives costs to: the slack, if there is one, and the generators."""
        return self.generators if self.slack is None else (self.slack, *self.generators)

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

    def knot_times(self, horizon_s: float) -> Array:
        """Equidistant times from 0 to the horizon, shape (n_knots,), s."""
        return np.linspace(0.0, horizon_s, self.n_knots)

    def bounds(self, regime: str) -> Bounds:
        """Bounds on frequencies.

        Raises:
            InputError: the case has no such regime.
        """
        self.check_regimes([regime])
        return self.regimes[regime].bounds(self.inertia)

    def omega_bound(self, regime: str) -> float:
        """Bound on |omega| of every generator in rad/s.

        Raises:
            InputError: the case has no such regime, or the regime bounds something else.
        """
        self.check_regimes([regime])
        limits = self.regimes[regime]
        if not isinstance(limits, Regime):
            problem = "bounds the mean frequency and swings about it, not |omega|, which is needed here"
            raise InputError(f"case {self.id}", f"regimes.{regime}", problem)
        return 2 * np.pi * limits.omega_hz

    def casadi(self, plant: str | None = None) -> Any:
        """The equations of its plant, or of another, as CasADi expressions: a `learning.CasadiModel`.

        Raises:
            InputError: there is no such plant, or its equations are not known to CasADi.
        """
        return importlib.import_module("ded_bench.learning").casadi_model(self, plant)

    def check_regimes(self, regimes: Iterable[str]) -> None:
        """Raise InputError unless the case knows every one of the regimes."""
        for regime in regimes:
            if regime not in self.regimes:
                problem = f"unknown regime {regime!r} (known: {', '.join(self.regimes)})"
                raise InputError(f"case {self.id}", "regime", problem)


@functools.lru_cache(maxsize=4)
def _unpickled(content: bytes) -> Case:
    kind, state = pickle.loads(content)  # part of a pickle itself
    case: Case = kind.__new__(kind)
    case.__setstate__(state)
    return case


def _record_of(text: str, path: Path) -> type[Case]:
    """The record of a file's schema; a file that is none of JSON is refused as the oldest.

    Raises:
        InputError: there is no such schema.
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        data = None
    schema = str(data.get("schema")) if isinstance(data, dict) else min(SCHEMAS)
    if schema not in SCHEMAS:
        raise InputError(path, "schema", f"is {schema[:60]!r}, not one of {', '.join(SCHEMAS)}")
    record: type[Case] = pkgutil.resolve_name(SCHEMAS[schema])
    return record


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
