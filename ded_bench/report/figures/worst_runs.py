"""The worst kept run of each method: its frequencies against the bound."""

from __future__ import annotations

from collections.abc import Iterator

from ded_bench.analysis.lines import main_lines, records, where
from ded_bench.analysis.summary import worst
from ded_bench.report.figures.panels import RAD_TO_HZ, Panel, time_figure
from ded_bench.report.figures.schedules import shown_run
from ded_bench.report.figures.style import Drawn
from ded_bench.report.sources import Sources


def draw(sources: Sources) -> Iterator[Drawn]:
    """One figure per regime, of the main lines of methods that break a limit or cost more."""
    rows = main_lines(sources.judged)
    rows = where(rows, map(sources.has_schedule, rows["key"]))
    keys = {(row.regime, row.method, row.instance): row.key for row in rows.itertuples()}
    found = worst(rows, 1)
    found = found[~found.duplicated(["regime", "title"], keep="last")]  # a violation rather than a gap
    for regime, limit in sources.case.regimes.items():
        panels = []
        for row in records(found[found["regime"] == regime]):
            one = shown_run(sources, row | {"key": keys[regime, row["method"], row["instance"]]})
            if one:
                what = f"{row['broken']}: {row['excess']:.2g} × tolerance"
                what = what if row["broken"] else f"{row['gap_percent']:+.2g} %"
                curves = [one.curve(1e3 * RAD_TO_HZ * one.omega)]
                bound = 1e3 * limit.largest_hz
                title = f"{one.label}\n{row['instance']}, {what}"
                panels.append(Panel("frequency (mHz)", curves, (bound, -bound), title))
        if panels:
            caption = (
                f"{regime}: all frequencies of each method's worst run, of those whose schedules are in the "
                "folder: the largest violation, or else the largest gap; dotted: the bounds."
            )
            yield Drawn(
                f"worst_{regime}", caption, time_figure("", panels, min(3, len(panels)), legend=False)
            )
