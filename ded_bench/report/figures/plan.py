"""Which runs the figures show: one representative instance per regime, the worst of each method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pandas as pd

from ded_bench.evaluate.summary import REFERENCE, gaps, groups, judged_rows, worst
from ded_bench.run.results import Key, Results

#: Whose schedule the paper's figures show beside DED's: the first of these that was run.
CHALLENGERS = ("ded-dpc", "ded-dpc-paper", "ded-ko-knots", "ded-ko")
WORST = 3


@dataclass(frozen=True)
class Plan:
    """What to draw: per regime the runs of one representative instance, per method its worst runs.

    Of a method with several settings, those of the default are drawn.
    """

    representative: dict[str, list[Key]] = field(default_factory=dict)
    worst: dict[tuple[str, str, str], list[tuple[Key, str]]] = field(default_factory=dict)

    @property
    def keys(self) -> list[Key]:
        """Every schedule that the figures need, DED's for comparison included."""
        compared = [Key(k.instance, k.regime, *REFERENCE) for pairs in self.worst.values() for k, _ in pairs]
        return list(dict.fromkeys(self.shown + compared))

    @property
    def shown(self) -> list[Key]:
        """The runs whose trajectories are drawn."""
        keys = [key for chosen in self.representative.values() for key in chosen]
        keys += [key for pairs in self.worst.values() for key, _ in pairs]
        return list(dict.fromkeys(keys))


def figure_schedules(results: Results) -> list[Key]:
    """The schedules that a report's figures are drawn from: what a published run must keep."""
    keys = plan(judged_rows(results.frame()), lambda key: results.schedule_path(key).is_file()).keys
    return [key for key in keys if results.schedule_path(key).is_file()]


def plan(frame: pd.DataFrame, available: Callable[[Key], bool]) -> Plan:
    """Choose the runs to show from the rows of a results table.

    The representative instance of a regime is the one whose gap is the median of the challenger's;
    if its schedules are not there, the next nearest to it.
    """
    scored = gaps(frame).dropna(subset=["objective"])
    chosen = Plan()
    for regime in sorted(set(scored["regime"])):
        chosen.representative[regime] = _representative(scored[scored["regime"] == regime], regime, available)
    for regime, method, settings, group in groups(worst(first_settings(scored), WORST)):
        ranked = []
        by_gap = group[group["worst_by"] == "gap"]
        by_violation = group[group["worst_by"] == "violation"]
        for row in (by_gap if len(by_gap) else by_violation).to_dict("records"):
            gap = f"{row['gap_percent']:+.3g} %" if len(by_gap) else f"{row['excess']:.2g} × tolerance"
            ranked.append((str(row["instance"]), f"{row['instance']}\n{gap}"))
        for row in by_violation[by_violation["excess"] > 1].head(1 if len(by_gap) else 0).to_dict("records"):
            if row["instance"] not in [name for name, _ in ranked]:
                reason = f"{row['instance']}\nworst violation, {row['excess']:.2g} × tolerance"
                ranked.append((str(row["instance"]), reason))
        keys = [(Key(name, regime, method, settings), reason) for name, reason in ranked]
        chosen.worst[regime, method, settings] = [pair for pair in keys if available(pair[0])]
    return chosen


def first_settings(rows: pd.DataFrame) -> pd.DataFrame:
    """Each method's rows with its default settings, or the first by name if it has none with those."""
    ranked = rows.assign(_name=[name if name != "default" else "" for name in rows["settings"]])
    first = ranked.groupby("method")["_name"].transform("min")
    return rows[ranked["_name"] == first]


def _representative(rows: pd.DataFrame, regime: str, available: Callable[[Key], bool]) -> list[Key]:
    for method in (*CHALLENGERS, REFERENCE[0]):
        settings = "default"
        mine = rows[(rows["method"] == method) & (rows["settings"] == settings)]
        mine = mine.dropna(subset=["gap_percent"]).sort_values(["gap_percent", "instance"])
        if not len(mine):
            continue
        middle = mine["gap_percent"].iloc[(len(mine) - 1) // 2]
        distance = (mine["gap_percent"] - middle).abs()
        for instance in mine.assign(distance=distance).sort_values(["distance", "instance"])["instance"]:
            keys = [Key(instance, regime, *REFERENCE), Key(instance, regime, method, settings)]
            if all(available(key) for key in keys):
                return list(dict.fromkeys(keys))
    return []
