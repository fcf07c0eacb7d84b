"""Claimed, verified, validated: the rows of a results folder beside what the full AC network says of them.

Solvers claim, the scorer on the lossless network verifies, the scorer on the AC network validates.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from ded_bench.evaluate.summary import GROUP, HEAD, SUCCESS, groups, table, title
from ded_bench.run.ac_scoring import AC_ROWS, AcRow

#: Whose cost on the AC network others are compared with there: the optimum of that problem.
YARDSTICK = ("ded-slp", "ac")
COLUMNS = (
    *HEAD,
    "instances",
    "claimed",
    "verified",
    "validated",
    "validated_strict",
    "only_verified",
    "no_solution",
    "freq_violation_hz_mean",
    "freq_violation_hz_max",
    "n",
    "gap_percent_mean",
)
KEY = ["instance", *GROUP]


def with_ac(frame: pd.DataFrame, ac_rows: Iterable[AcRow]) -> pd.DataFrame:
    """The rows that were scored on the AC network, with what was found there.

    Args:
        frame: rows of a results table.
        ac_rows: of `ac.csv`; those whose schedule is no longer the row's do not count.

    Returns:
        The frame with columns `ac_objective`, `ac_freq_violation_hz`, `ac_feasible`, `ac_feasible_strict`,
        `ac_error` and `carried`: whether the AC network can carry the instance under some row's schedule.
    """
    scores = AC_ROWS.frame(ac_rows)
    names = ["objective", "freq_violation_hz", "feasible", "feasible_strict", "error"]
    scores = scores[[*KEY, "fingerprint", *names]].rename(columns={name: f"ac_{name}" for name in names})
    both = frame.merge(scores, on=[*KEY, "fingerprint"], how="inner")
    carried = set(both.loc[both["ac_objective"].notna(), "instance"])
    return both.assign(carried=both["instance"].isin(carried))


def validated(both: pd.DataFrame) -> pd.DataFrame:
    """One line per (regime, method, settings), over the instances that the AC network can carry.

    Args:
        both: see `with_ac`.

    Returns:
        Shares of the rows: `claimed` by solvers, `verified` on the lossless network, `validated` on the AC
        network (`validated_strict`: strictly), `only_verified` feasible on the first and not on the second,
        `no_solution` on the AC network under this schedule. Excess of |ω| on the AC network in Hz over those
        that have one; `gap_percent_mean`: cost there over that of YARDSTICK, where that is strictly feasible,
        on `n` rows.
    """
    both = both[both["carried"]]
    ours = both[(both["method"] == YARDSTICK[0]) & (both["settings"] == YARDSTICK[1])]
    ours = ours[_is(ours["ac_feasible_strict"])]
    best = ours.set_index(["instance", "regime"])["ac_objective"]
    rows = []
    for regime, method, settings, group in groups(both):
        here, there = _is(group["feasible"]), _is(group["ac_feasible"])
        excess = group["ac_freq_violation_hz"].dropna()
        reference = best.reindex(pd.MultiIndex.from_frame(group[["instance", "regime"]])).to_numpy(
            dtype=float
        )
        gap = 100.0 * (group["ac_objective"].to_numpy(dtype=float) / reference - 1.0)
        gap = gap[np.isfinite(gap)]
        values = (
            *(regime, method, settings, title(method, settings), len(group)),
            float(group["status"].isin([str(status) for status in SUCCESS]).mean()),
            float(here.mean()),
            float(there.mean()),
            float(_is(group["ac_feasible_strict"]).mean()),
            float((here & ~there).mean()),
            float(group["ac_objective"].isna().mean()),
            float(excess.mean()) if len(excess) else np.nan,
            float(excess.max()) if len(excess) else np.nan,
            len(gap),
            float(gap.mean()) if len(gap) else np.nan,
        )
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return table(rows, COLUMNS)


def _is(values: pd.Series[bool]) -> pd.Series[bool]:
    """True cells; empty ones are not."""
    return values.fillna(False).astype(bool)
