"""Schedules of one representative instance per regime, and frequencies under them in the tightest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import main_lines, records, titled, where
from ded_bench.methods.registry import METHODS
from ded_bench.report.figures.panels import (
    Shown,
    frequency_panels,
    load_panel,
    power_panels,
    slack_panel,
    time_figure,
)
from ded_bench.report.figures.style import Drawn
from ded_bench.report.sources import Sources


def draw(sources: Sources) -> Iterator[Drawn]:
    """Of every regime that has a pair of schedules (paper, Figs. NO_cmp, TO_cmp, freq_cmp)."""
    case = sources.case
    for regime in case.regimes:
        chosen = representative(sources, regime)
        rows = enumerate(records(chosen))
        shown = [one for place, row in rows if (one := shown_run(sources, row, place))]
        if not shown:
            continue
        heading = f"{chosen['instance'].iloc[0]}, {regime}"
        names = " and ".join(one.label for one in reversed(shown))
        caption = (
            f"{names} on {heading}: generator powers with bounds, loads, slack power. The instance's gap is "
            "near the median of those whose schedules are kept, and its loads move most."
        )
        panels = [*power_panels(case, shown), load_panel(case, shown[0]), slack_panel(case, shown)]
        yield Drawn(f"schedule_{regime}", caption, time_figure(heading, panels, 2))
        if regime == sources.tightest:
            caption = f"Frequencies under {names} on {heading}; dotted: the regime's bounds."
            panels = frequency_panels(case, regime, shown, 4)
            yield Drawn(f"frequencies_{regime}", caption, time_figure(heading, panels, 1))


def shown_run(sources: Sources, row: dict[Any, Any], place: int = 0) -> Shown | None:
    """What figures show of a row; None if it cannot be simulated."""
    run = sources.trajectory(row["key"])
    arrays = (run.t, run.p_gen, run.omega, run.p_load, run.p_slack) if run else ()
    return Shown(row["method"], row["title"], place, *arrays) if run else None


def representative(sources: Sources, regime: str) -> pd.DataFrame:
    """Rows of the reference and a challenger on one instance; none without such a pair.

    Trained methods come before others, and the smaller the mean gap, the earlier. Of the instances whose
    schedules are kept, the third with gaps nearest to the challenger's median takes part; the one whose
    loads move most is chosen.
    """
    rows = titled(
        main_lines(sources.judged[sources.judged["regime"] == regime].dropna(subset=["gap_percent"]))
    )
    gaps = rows["gap_percent"].groupby(rows["method"])
    rows = rows.assign(distance=(rows["gap_percent"] - gaps.transform("median")).abs())
    kept = where(rows, map(sources.has_schedule, rows["key"]))
    reference = kept[kept["method"] == sources.reference.method]
    for method in challengers(gaps.agg(lambda gap: gap.abs().mean()), sources.reference.method):
        pairs = kept[(kept["method"] == method) & kept["instance"].isin(reference["instance"])]
        if len(pairs):
            usual = pairs.nsmallest(-(-len(pairs) // 3), "distance")["instance"]
            chosen = max(usual, key=lambda name: _movement(sources, name))
            both = pd.concat([reference, pairs])
            return where(both, both["instance"] == chosen)
    return kept.iloc[:0]


def challengers(distance: pd.Series[float], reference: str) -> list[str]:
    """The methods that may stand beside the reference, first choice first; `distance` is their mean gap."""
    trained = {name for name, method in METHODS.items() if method.trainer}
    others = (str(name) for name in distance.index if name != reference)
    return sorted(others, key=lambda name: (name not in trained, distance[name], name))


def _movement(sources: Sources, name: str) -> float:
    return float(np.ptp(sources.instances[name].p_load(sources.case), axis=0).sum())
