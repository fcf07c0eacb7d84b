"""What a results folder keeps of the closed loop: rows, hindsight, and trajectories for figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Table, cell, plain_name
from ded_bench.plants.score import AGC_COLUMN
from ded_bench.problem.forecast import QUALITIES
from ded_bench.problem.trajectory import Trajectory
from ded_bench.results.folder import PLANT, OnlineKey, ResultsFolder
from ded_bench.results.legacy import upgraded

#: Trajectories are kept at points this far apart, s.
KEPT_S = 0.1


def _quality(text: str) -> str:
    if text not in QUALITIES:
        raise ValueError(text)
    return text


@dataclass(frozen=True)
class OnlineRow:
    """One scenario operated with one method's plans, judged on the plant that was operated (see `Judgement`).

    `unforeseen_hz` is how far loads that no plan knew of move frequencies; it depends on no method.
    `increase_percent` is over hindsight; `predicted` says that plans started from the state predicted for
    the time they took effect; `warm` that the method might start from the plan in force, and `warm_used`
    that it takes one. `failed` counts answers without a schedule, `infeasible` those with one that, by the
    method's own word, exceeds limits as little as it can. `method_s` and `loop_s` are wall-clock seconds of
    the method, and of all else.
    """

    scenario: str = cell(check=plain_name)
    regime: str = cell(check=plain_name)
    method: str = cell(check=plain_name)
    settings: str = cell(check=plain_name)
    period_s: float = cell(lowest=0)
    latency_s: float = cell(lowest=0)
    forecast: str = cell(check=_quality)
    predicted: bool = cell()
    warm: bool = cell()
    plant: str = cell(default=PLANT, check=plain_name)
    objective: float | None = None
    increase_percent: float | None = None
    max_excess_hz: float | None = cell(default=None, lowest=0)
    mean_excess_hz: float | None = cell(default=None, lowest=0)
    share_outside: float | None = cell(default=None, lowest=0, highest=1)
    ramp_violation: float | None = cell(default=None, lowest=0)
    bound_violation: float | None = cell(default=None, lowest=0)
    slack_travel_pu: float | None = cell(default=None, lowest=0)
    mean_freq_rms_hz: float | None = cell(default=None, lowest=0)
    mean_freq_max_hz: float | None = cell(default=None, lowest=0)
    swing_rms_hz: float | None = cell(default=None, lowest=0)
    swing_max_hz: float | None = cell(default=None, lowest=0)
    excess_mean_hz: float | None = cell(default=None, lowest=0)
    excess_relative_hz: float | None = cell(default=None, lowest=0)
    excess_end_hz: float | None = cell(default=None, lowest=0)
    agc_travel_pu: float | None = cell(default=None, lowest=0)
    cps1: float | None = None
    unforeseen_hz: float | None = cell(default=None, lowest=0)
    plans: int = cell(default=0, lowest=0)
    late: int = cell(default=0, lowest=0)
    failed: int = cell(default=0, lowest=0)
    infeasible: int = cell(default=0, lowest=0)
    warm_used: bool = False
    error: str = ""
    limit_s: float | None = None
    method_s: float | None = None
    loop_s: float | None = None
    latency_source: str = ""  # timing, zero or given
    case: str = ""
    model: str = cell(default="", check=plain_name)
    policy: str = cell(default="", check=plain_name)
    fingerprint: str = ""
    version: str = ""
    commit: str = ""
    method_version: int = 0
    host: str = ""
    date: str = ""

    @property
    def key(self) -> OnlineKey:
        """The row's place in the table."""
        return OnlineKey(*(getattr(self, name) for name in OnlineKey._fields))


@dataclass(frozen=True)
class HindsightRow:
    """The optimum of one scenario and regime with full knowledge, judged as the rows of `online.csv`."""

    scenario: str = cell(check=plain_name)
    regime: str = cell(check=plain_name)
    plant: str = cell(default=PLANT, check=plain_name)
    method: str = ""
    objective: float | None = None
    max_excess_hz: float | None = None
    slack_travel_pu: float | None = None
    error: str = ""
    case: str = ""
    fingerprint: str = ""
    version: str = ""
    commit: str = ""
    method_version: int = 0
    host: str = ""
    date: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """The row's place in the table."""
        return self.scenario, self.regime, self.plant


ONLINE = Table(OnlineRow, since="method_version", upgrade=upgraded)
HINDSIGHT = Table(HindsightRow, since="method_version", upgrade=upgraded)


class OnlineResults:
    """The tables of the closed loop in a results folder, and where the files beside them lie.

    Raises:
        InputError: there is a table, but it is wrong.
    """

    def __init__(self, folder: Path) -> None:
        self.files = ResultsFolder(folder)
        self.table = KeyedTable[OnlineKey, OnlineRow](self.files.online, ONLINE)
        self.hindsight = KeyedTable[tuple[str, str, str], HindsightRow](self.files.hindsight, HINDSIGHT)


def keep_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write times (s), powers of generators, slack and AGC, loads (pu) and frequency deviations (rad/s)."""
    stride = max(round(KEPT_S / (trajectory.t[1] - trajectory.t[0])), 1)
    names = ("t", "p_gen", "p_slack", "p_load", "omega")
    arrays = {name: getattr(trajectory, name)[::stride] for name in names}
    if AGC_COLUMN in trajectory.columns:
        arrays[AGC_COLUMN] = trajectory.columns[AGC_COLUMN][::stride]
    write_arrays(path, arrays, {"kept_s": KEPT_S})


def read_trajectory(path: Path) -> dict[str, np.ndarray]:
    """Read what `keep_trajectory` wrote; InputError if it is missing or damaged."""
    return read_arrays(path)[0]
