"""Which runs the figures show: one representative instance per regime, the worst of each method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.summary import groups, worst
from ded_bench.methods.registry import METHODS
from ded_bench.results.rows import Key

#: How many of the worst instances of each method are drawn.
WORST = 3


@dataclass(frozen=True)
class Plan:
    """What to draw: per regime the runs of one representative instance, per method its worst runs.

    Of a method with several settings, those of the default are drawn.

    Attributes:
        reference: method and settings that gaps are measured against.
    """

    reference: tuple[str, str]
    representative: dict[str, list[Key]] = field(default_factory=dict)
    worst: dict[tuple[str, str, str], list[tuple[Key, str]]] = field(default_factory=dict)

    @property
    def keys(self) -> list[Key]:
        """Every run that the figures show, the reference's for comparison included."""
        keys = [key for chosen in self.representative.values() for key in chosen]
        keys += [key for pairs in self.worst.values() for key, _ in pairs]
        keys += [Key(key.instance, key.regime, *self.reference) for key in keys]
        return list(dict.fromkeys(keys))


def plan(
    frame: pd.DataFrame,
    reference: tuple[str, str],
    available: Callable[[Key], bool],
    movement: Callable[[str], float],
) -> Plan:
    """Choose the runs to show from the rows of a results table with their gaps.

    The worst runs are those of the runs that can be drawn.

    Args:
        available: whether the schedule of a run can be drawn.
        movement: how far the static dispatch of an instance moves its generators.
    """
    scored = frame.dropna(subset=["objective"])
    keys = scored[list(Key._fields)].itertuples(index=False)
    drawable = scored[np.array([available(Key(*key)) for key in keys], dtype=bool)]
    chosen = Plan(reference)
    for regime in sorted(set(scored["regime"])):
        chosen.representative[regime] = _representative(
            scored[scored["regime"] == regime], regime, reference, available, movement
        )
    for regime, method, settings, group in groups(worst(first_settings(drawable), WORST)):
        ranked = []
        by_gap = group[group["worst_by"] == "gap"]
        by_violation = group[group["worst_by"] == "violation"]
        for row in (by_gap if len(by_gap) else by_violation).to_dict("records"):
            gap = (
                f"{row['gap_percent']:+.3g} %"
                if len(by_gap)
                else f"{row['broken']}: {row['excess']:.2g} × tolerance"
            )
            ranked.append((str(row["instance"]), f"{row['instance']}\n{gap}"))
        for row in by_violation[by_violation["excess"] > 1].head(1 if len(by_gap) else 0).to_dict("records"):
            if row["instance"] not in [name for name, _ in ranked]:
                reason = f"{row['instance']}\n{_broken(row)}"
                ranked.append((str(row["instance"]), reason))
        chosen.worst[regime, method, settings] = [
            (Key(name, regime, method, settings), reason) for name, reason in ranked
        ]
    return chosen


def _broken(row: Mapping[Any, Any]) -> str:
    """The limit that a run breaks most, and by how much."""
    return f"{row['broken']}: {row['excess']:.2g} × tolerance"


def first_settings(rows: pd.DataFrame) -> pd.DataFrame:
    """Each method's rows with its default settings, or the first by name if it has none with those."""
    ranked = rows.assign(_name=[name if name != "default" else "" for name in rows["settings"]])
    first = ranked.groupby("method")["_name"].transform("min")
    return rows[ranked["_name"] == first]


def challengers(rows: pd.DataFrame, reference: str) -> list[str]:
    """The methods whose schedule the paper's figures may show beside the reference's, first choice first.

    Trained methods come before others, and the smaller the mean distance to the reference, the earlier.

    Args:
        rows: of one regime, with their gaps.
    """
    others = rows[(rows["settings"] == "default") & (rows["method"] != reference)]
    distance = others["gap_percent"].abs().groupby(others["method"]).mean().dropna()
    return sorted(distance.index, key=lambda name: (not is_trained(name), distance[name], name))


def is_trained(name: str) -> bool:
    """Whether a method of this name is registered and trained."""
    return name in METHODS and bool(METHODS[name].trainer)


def _representative(
    rows: pd.DataFrame,
    regime: str,
    reference: tuple[str, str],
    available: Callable[[Key], bool],
    movement: Callable[[str], float],
) -> list[Key]:
    """The reference's and a challenger's run on one instance: usual by its gap, and one where much moves.

    Of the instances that can be drawn, the third whose gaps are nearest to the challenger's median takes
    part; the one whose static dispatch moves the generators most is chosen.
    """
    for method in (*challengers(rows, reference[0]), reference[0]):
        mine = rows[(rows["method"] == method) & (rows["settings"] == "default")].dropna(
            subset=["gap_percent"]
        )
        if not len(mine):
            continue
        distance = (mine["gap_percent"] - mine["gap_percent"].median()).abs()
        ranked = mine.assign(distance=distance).sort_values(["distance", "instance"])["instance"]
        pairs = [
            list(dict.fromkeys([Key(name, regime, *reference), Key(name, regime, method, "default")]))
            for name in ranked
        ]
        drawable = [keys for keys in pairs if all(available(key) for key in keys)]
        if drawable:
            usual = drawable[: -(-len(drawable) // 3)]
            return max(usual, key=lambda keys: (movement(keys[0].instance), keys[0].instance))
    return []
