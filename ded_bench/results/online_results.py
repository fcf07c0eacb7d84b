"""What a results folder keeps of the closed loop: rows, hindsight, and trajectories for figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from ded_bench.files.arrays import write_arrays
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Count, NotNegative, PlainName, Table
from ded_bench.plants.score import AGC_COLUMN
from ded_bench.problem.quantities import Probability
from ded_bench.problem.scenario import QUALITIES
from ded_bench.problem.schedule import Trajectory
from ded_bench.results.folder import PLANT, OnlineKey, ResultsFolder
from ded_bench.results.legacy import upgraded
from ded_bench.results.rows import Made, OfIslands

#: Trajectories are kept at points this far apart, s.
KEPT_S = 0.1

_Forecast = Annotated[str, Field(pattern=f"^({'|'.join(QUALITIES)})$")]


@dataclass(frozen=True, kw_only=True)
class Judgement(OfIslands):
    """One trajectory in one regime; the excess at a point of time is that over the most exceeded bound.

    Islands have numbers about the mean frequency and swings about it, too.
    """

    objective: float | None = None  # Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all points, as of the scorer
    max_excess_hz: NotNegative | None = None  # the largest, also over what counts at the end only
    mean_excess_hz: NotNegative | None = None  # mean over all grid points
    share_outside: Probability | None = None  # of the grid points where it is more than 1e-6 Hz
    ramp_violation: NotNegative | None = None  # pu per step
    bound_violation: NotNegative | None = None  # pu
    slack_travel_pu: NotNegative | None = None  # Σ_k |P_s(t_k+1) - P_s(t_k)|
    cps1: float | None = None  # %, see `judgement.cps1`


@dataclass(frozen=True)
class OnlineRow(Judgement, Made):
    """One scenario operated with one method's plans, judged on the plant that was operated.

    `unforeseen_hz` is how far loads that no plan knew of move frequencies; it depends on no method.
    `increase_percent` is over hindsight; `predicted` says that plans started from the state predicted for
    the time they took effect; `warm` that the method might start from the plan in force, and `warm_used`
    that it takes one. `failed` counts answers without a schedule, `infeasible` those with one that, by the
    method's own word, exceeds limits as little as it can. `method_s` and `loop_s` are wall-clock seconds of
    the plans, from measurements to answers, and of all else, `plant_s` those of the plant among the latter.
    """

    scenario: PlainName
    regime: PlainName
    method: PlainName
    settings: PlainName
    period_s: NotNegative
    latency_s: NotNegative
    forecast: _Forecast
    predicted: bool
    warm: bool
    plant: PlainName = PLANT
    increase_percent: float | None = None
    unforeseen_hz: NotNegative | None = None
    plans: Count = 0
    late: Count = 0
    failed: Count = 0
    infeasible: Count = 0
    warm_used: bool = False
    error: str = ""
    limit_s: float | None = None
    method_s: float | None = None
    loop_s: float | None = None
    plant_s: float | None = None
    latency_source: str = ""  # timing, zero or given
    model: PlainName = ""
    policy: PlainName = ""
    fingerprint: str = ""

    @property
    def key(self) -> OnlineKey:
        """The row's place in the table."""
        return OnlineKey(*(getattr(self, name) for name in OnlineKey._fields))


@dataclass(frozen=True)
class HindsightRow(Made):
    """The optimum of one scenario and regime with full knowledge, judged as the rows of `online.csv`."""

    scenario: PlainName
    regime: PlainName
    plant: PlainName = PLANT
    method: str = ""
    objective: float | None = None
    max_excess_hz: float | None = None
    slack_travel_pu: float | None = None
    error: str = ""
    fingerprint: str = ""

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
    write_arrays(path, arrays, {})
