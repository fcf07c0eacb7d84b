"""The closed loop: one scenario under several methods, static dispatch and on islands practice among them."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ded_bench.analysis.lines import titled, where
from ded_bench.analysis.online_summary import PRACTICE, STATIC
from ded_bench.problem.scenario import QUALITIES
from ded_bench.report.figures.panels import (
    Shown,
    agc_panel,
    balance_panel,
    frequency_panels,
    load_panel,
    power_panels,
    time_figure,
)
from ded_bench.report.figures.style import Drawn
from ded_bench.report.sources import Sources
from ded_bench.results.online_results import read_trajectory

#: Static dispatch that is drawn, method and settings; what moves most comes first, below the others.
STATICS = ((PRACTICE[0], "every=300"), PRACTICE, STATIC)
#: At most so many methods beside it, and generators, are drawn of a scenario.
METHODS_SHOWN, GENERATORS_SHOWN = 2, 3


def draw(sources: Sources) -> Iterator[Drawn]:
    """Of the scenario that is chosen, if any is kept."""
    scenario, shown = shown_scenario(sources)
    if shown:
        case, heading = sources.case, f"{scenario}, {sources.tightest}"
        names = ", ".join(one.label for one in shown)
        last = "slack power" if case.slack else "secondary control (AGC)"
        caption = f"Scenario {heading}: loads, powers, frequencies and {last} under {names}."
        panels = [load_panel(case, shown[0]), *power_panels(case, shown, GENERATORS_SHOWN)]
        panels += frequency_panels(case, sources.tightest, shown, GENERATORS_SHOWN)
        panels.append(balance_panel(case, sources.tightest, shown) if case.slack else agc_panel(shown))
        yield Drawn("online_scenario", caption, time_figure(heading, panels, 1))


def shown_scenario(sources: Sources) -> tuple[str, list[Shown]]:
    """A scenario of the tightest regime and trajectories to show; none if none is kept.

    Of the scenarios with most lines, the one whose worst excess is the median; static dispatch, and of the
    other methods those of least excess, each with its best line.
    """
    files, rows = sources.results.paths, sources.online if sources.case.slack else sources.practice
    rows = rows[(rows["regime"] == sources.tightest) & (rows["forecast"] == QUALITIES[0])]
    rows = where(rows, (files.trajectory(key).is_file() for key in rows["key"]))
    if not len(rows):
        return "", []
    lines = rows.groupby("scenario")["key"].transform("size")
    excess = rows[lines == lines.max()].groupby("scenario")["max_excess_hz"].max()
    scenario = str(excess.sort_values(kind="stable").index[len(excess) // 2])
    one = titled(rows[rows["scenario"] == scenario]).sort_values("max_excess_hz", kind="stable")
    is_static = one["method"] == STATIC[0]
    statics = [one[is_static & (one["settings"] == settings)][:1] for _, settings in STATICS]
    chosen = pd.concat([*statics, one[~is_static].drop_duplicates("method")[:METHODS_SHOWN]])
    paths = {
        (row["method"], f"{row['title']}, {row['latency_s']:.2g} s"): files.trajectory(row["key"])
        for row in chosen.to_dict("records")
    }
    hindsight = files.hindsight_trajectory(scenario, sources.tightest, sources.case.plant_name)
    if hindsight.is_file():  # first, below the others
        paths = {("", "hindsight"): hindsight} | paths
    read = [(*key, read_trajectory(path)) for key, path in paths.items()]
    return scenario, [Shown(m, label, i, **arrays) for i, (m, label, arrays) in enumerate(read)]
