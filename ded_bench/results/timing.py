"""The table of times: one row per call of a method, and medians per method, settings, model and regime."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ded_bench.files.table import NotNegative, Table
from ded_bench.results.legacy import upgraded
from ded_bench.results.rows import Made

#: Round of a process's very first call, on the warm-up instance; it enters no median.
WARM_UP = 0
#: `time_s`, what a schedule takes, is build_s + solve_s.
PARTS = ("build_s", "setup_s", "solve_s", "time_s")


@dataclass(frozen=True)
class TimingRow(Made):
    """One call of one method, wall-clock seconds.

    `call_s` is the whole call as its process saw it, `load_average` the machine's over the last minute when
    it ended: at most about 1 if bench was alone. `peak_memory_mib` is the most that its process had held by
    the end of the call, all that it imports included.
    """

    run: str
    round: int
    regime: str
    method: str
    settings: str
    instance: str
    status: str
    build_s: NotNegative | None = None
    setup_s: NotNegative | None = None
    solve_s: NotNegative | None = None
    call_s: NotNegative | None = None
    load_average: NotNegative | None = None
    peak_memory_mib: NotNegative | None = None
    error: str = ""
    model: str = ""
    policy: str = ""
    problems_version: str = ""
    solver_version: str = ""

    @property
    def job(self) -> tuple[str, str, str, str]:
        """Regime, method, settings and the surrogate's name: what is timed."""
        return self.regime, self.method, self.settings, model_name(self.model)

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes a row unique within its run."""
        return self.round, *self.job, self.instance

    @property
    def counts(self) -> bool:
        """Whether it enters medians: a call that succeeded, and no process's first."""
        return self.round != WARM_UP and not self.error


TIMING: Table[TimingRow] = Table(TimingRow, since="method_version", upgrade=upgraded)


def model_name(model: str) -> str:
    """The surrogate's name in `name@fingerprint`; empty for none."""
    return model.partition("@")[0]


def timing_summary(rows: Sequence[TimingRow]) -> pd.DataFrame:
    """Median and quartiles per case and job over instances and rounds, s; `model` is the surrogate's name.

    The first call of each process does not count; calls that failed count in `failures` and enter no
    median. `load_average` is the median of the calls', `peak_memory_mib` the largest.
    """
    frame = TIMING.frame(rows)
    frame["model"] = frame["model"].map(model_name)
    frame["time_s"] = frame["build_s"].fillna(0.0) + frame["solve_s"]
    last = frame.groupby(_JOB, sort=False)[_SAID].last()
    warm = frame[frame["round"] != WARM_UP]
    is_good = warm["error"] == ""
    calls, good, failed = (part.groupby(_JOB) for part in (warm, warm[is_good], warm[~is_good]))
    counts = {"instances": calls["instance"].nunique(), "repeats": calls["round"].max()}
    counts |= {"failures": failed.size()}
    found = last.assign(**{name: values.reindex(last.index, fill_value=0) for name, values in counts.items()})
    found["load_average"] = calls["load_average"].median()
    found["peak_memory_mib"] = calls["peak_memory_mib"].max()
    for end, part in (("", 0.5), ("_q1", 0.25), ("_q3", 0.75)):
        found[[f"{name}{end}" for name in PARTS]] = good[list(PARTS)].quantile(part)
    reasons = failed["error"].first().reindex(last.index, fill_value="")
    return found.assign(error=reasons.mask(last.index.isin(good.size().index), "")).reset_index()


_JOB = ["case", "regime", "method", "settings", "model"]
_SAID = ["run", "problems_version", "version", "commit", "solver_version", "host", "date", "policy"]
