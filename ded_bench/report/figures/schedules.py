"""Schedules of one representative instance per regime, and frequencies under them in the tightest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from ded_bench.analysis.lines import main_lines, records, titled, where
from ded_bench.methods.registry import METHODS
from ded_bench.report.figures.panels import (
    Shown,
    balance_panel,
    frequency_panels,
    load_panel,
    power_panels,
    time_figure,
)
from ded_bench.report.figures.style import Drawn
from ded_bench.report.sources import Sources


def draw(sources: Sources) -> Iterator[Drawn]:
    """Of every regime that has a schedule (paper, Figs. NO_cmp, TO_cmp, freq_cmp)."""
    case = sources.case
    for regime in case.regimes:
        chosen = representative(sources, regime)
        rows = enumerate(records(chosen))
        shown = [one for place, row in rows if (one := shown_run(sources, row, place))]
        if not shown:
            continue
        heading = f"{chosen['instance'].iloc[0]}, {regime}"
        last = "mean frequency" if case.slack is None else "slack power"
        names = " and ".join(one.label for one in reversed(shown))
        caption = f"{names} on {heading}: set-points with bounds, loads, {last}; the gap is near the median"
        panels = [*power_panels(case, shown), load_panel(case, shown[0]), balance_panel(case, regime, shown)]
        yield Drawn(f"schedule_{regime}", caption, time_figure(heading, panels, 2))
        if regime == sources.tightest:
            caption = f"Frequencies under {names} on {heading}; dotted: the regime's bounds."
            panels = frequency_panels(case, regime, shown, 4)
            yield Drawn(f"frequencies_{regime}", caption, time_figure(heading, panels, 1))


def shown_run(sources: Sources, row: dict[Any, Any], place: int = 0) -> Shown | None:
    """What figures show of a row; None if it cannot be simulated."""
    run = sources.trajectory(row["key"])
    arrays = (run.t, run.p_set, run.omega, run.p_load, run.p_slack) if run else ()
    return Shown(row["method"], row["title"], place, *arrays) if run else None


def representative(sources: Sources, regime: str) -> pd.DataFrame:
    """Rows of the reference, if it was run, and a challenger on one instance; none without a kept schedule.

    Trained methods come before others, and the smaller the mean gap, the earlier. Of the instances whose
    schedules are kept, the one whose gap is nearest to the challenger's median is chosen.
    """
    rows = main_lines(sources.judged[sources.judged["regime"] == regime].dropna(subset=["objective"]))
    rows = rows.assign(gap_percent=rows["gap_percent"].fillna(0.0))
    kept = titled(where(rows, map(sources.has_schedule, rows["key"])))
    reference = kept[kept["method"] == sources.reference.method]
    gaps = rows["gap_percent"].groupby(rows["method"])
    trained = {name for name, method in METHODS.items() if method.trainer}
    distance = gaps.agg(lambda gap: gap.abs().mean())
    for method in sorted(distance.index, key=lambda name: (name not in trained, distance[name], name)):
        pairs = kept[kept["method"] == method]
        if method != sources.reference.method and len(reference):
            pairs = pairs[pairs["instance"].isin(reference["instance"])]
        if (method != sources.reference.method or len(distance) == 1) and len(pairs):
            off = (pairs["gap_percent"] - gaps.get_group(method).median()).abs()
            both = pd.concat([reference, pairs]).drop_duplicates(["method", "instance"])
            return where(both, both["instance"] == pairs.loc[off.idxmin(), "instance"])
    return kept.iloc[:0]
