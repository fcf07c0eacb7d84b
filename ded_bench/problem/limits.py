"""Limits: of machines, of the frequencies in a regime, and of what a group of machines may deliver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from ded_bench.files.strict import Record
from ded_bench.problem.quantities import Array, Extended, Magnitude, Name, NonNegative, Number, Positive


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds on monitored outputs y = matrix @ ω: |y| ≤ limit at every time, or at the last only.

    One form for every regime, so that the scorer and programs with frequency rows need no other: a row of a
    program is a row of `matrix` times the response of ω, and those of `at_end` exist at the last time only.
    """

    matrix: Array  # (n_out, n_gen)
    limit: Array  # (n_out,), rad/s
    at_end: NDArray[np.bool_]  # (n_out,)
    kinds: tuple[str, ...]  # (n_out,): `omega`, `mean`, `relative` or `end`

    def tightened(self, by: float | Array = 0.0, part: float = 0.0) -> Bounds:
        """Bounds that are smaller by a part of them, and by so many rad/s: one number, or one an output."""
        return replace(self, limit=(1.0 - part) * self.limit - by)

    def beyond(self, outputs: Array, ended: bool = True) -> Array:
        """How far outputs are beyond their bounds, negative within; -inf at times that a bound leaves free.

        Args:
            outputs: y up to the last time, shape (n, n_out), rad/s.
            ended: whether that is the end, where all bounds count.

        Returns:
            Of the same shape, rad/s.
        """
        beyond = np.abs(outputs) - self.limit
        beyond[: -1 if ended else None, self.at_end] = -np.inf
        return beyond

    def excess_hz(self, omega: Array, ended: bool = True) -> dict[str, float]:
        """Largest excess over the bounds of each kind, Hz, along frequency deviations (n, n_gen), rad/s."""
        excess = np.maximum(self.beyond(omega @ self.matrix.T, ended).max(axis=0), 0.0) / (2 * np.pi)
        kinds = np.array(self.kinds)
        return {kind: float(excess[kinds == kind].max()) for kind in dict.fromkeys(self.kinds)}


class Regime(Record):
    """Limits of one operating regime: |omega| at every generator stays within `omega_hz`."""

    omega_hz: Magnitude

    @property
    def largest_hz(self) -> float:
        """Largest deviation of a machine that the regime allows, Hz."""
        return self.omega_hz

    @property
    def sentence(self) -> str:
        """What is bounded, in words."""
        return f"|ω| ≤ {self.omega_hz:g} Hz"

    def bounds(self, inertia: Array) -> Bounds:
        """Its bounds on the frequencies of machines with this inertia, shape (n_gen,)."""
        n = len(inertia)
        limit = np.full(n, 2 * np.pi * self.omega_hz)
        return Bounds(np.eye(n), limit, np.zeros(n, dtype=bool), ("omega",) * n)


class IslandRegime(Record):
    """Limits on an island: of the inertia-weighted mean, of swings about it, of the mean at the end."""

    mean_hz: Magnitude
    relative_hz: Magnitude
    end_hz: Magnitude

    @property
    def largest_hz(self) -> float:
        """Largest deviation of a machine that the regime allows, Hz."""
        return self.mean_hz + self.relative_hz

    @property
    def sentence(self) -> str:
        """What is bounded, in words."""
        mean, swings, end = (f"{1e3 * hz:g}" for hz in (self.mean_hz, self.relative_hz, self.end_hz))
        return f"mean frequency ≤ {mean} mHz, at the end {end} mHz, swings about it ≤ {swings} mHz"

    def bounds(self, inertia: Array) -> Bounds:
        """See `Regime.bounds`."""
        n, mean = len(inertia), inertia / inertia.sum()
        hz = np.concatenate([[self.mean_hz], np.full(n, self.relative_hz), [self.end_hz]])
        kinds = ("mean", *("relative",) * n, "end")
        at_end = np.array([kind == "end" for kind in kinds])
        return Bounds(np.vstack([mean, np.eye(n) - mean, mean]), 2 * np.pi * hz, at_end, kinds)


class ScheduledMachine(Extended):
    """Power limits in pu and ramp limit of one machine."""

    p_nominal: Number
    p_min: Number
    p_max: Number
    ramp_pu_per_s: Magnitude | None = None  # case/2 and later; else the case's

    @model_validator(mode="after")
    def _ordered(self) -> ScheduledMachine:
        if not self.p_min < self.p_max:
            raise ValueError("p_min must be below p_max")
        return self


class Transfer(Record):
    """Σ set-points of `machines` - Σ powers drawn by `loads` ≤ `max`, pu."""

    name: Name
    machines: tuple[Name, ...]
    loads: tuple[Name, ...] = ()
    max: Number


class Agc(Record):
    """Secondary control: every `period_s` machine i gets -participation_i · k · ∫ mean omega dt, pu."""

    period_s: Positive
    k: NonNegative  # pu/rad
    participation: dict[Name, NonNegative]

    @model_validator(mode="after")
    def _whole(self) -> Agc:
        if abs(sum(self.participation.values()) - 1) > 1e-6:
            raise ValueError("participation: must sum to 1")
        return self
