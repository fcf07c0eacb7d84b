"""Which rows the figures and the list of worst instances are about."""

from __future__ import annotations

import pandas as pd

from ded_bench.report.figures.plan import challengers, first_settings
from ded_bench.report.gallery import without_curve


def test_methods_stand_with_their_default_settings_or_the_first_they_have() -> None:
    rows = pd.DataFrame(
        [("ed", "10s"), ("ed", "default"), ("ed", "default"), ("mine", "b"), ("mine", "a"), ("mine", "b")],
        columns=["method", "settings"],
    )
    kept = first_settings(rows)
    assert list(kept.itertuples(index=False, name=None)) == [
        ("ed", "default"),
        ("ed", "default"),
        ("mine", "a"),
    ]
    assert first_settings(rows[:0]).empty


def test_the_profile_names_the_methods_that_have_no_curve() -> None:
    columns = ["regime", "method", "settings"]
    rows = pd.DataFrame(
        [("NO", "ed", "default"), ("TO", "ed", "default"), ("TO", "ed", "1s")], columns=columns
    )
    assert without_curve(rows, rows) == "."
    assert without_curve(rows, rows[:1]) == "; ED in TO, ED [1s] in TO had none and no curve."


def test_trained_methods_are_shown_first_then_those_nearest_to_the_reference() -> None:
    cells = [
        ("ded", 0.0),
        ("ded-ko", -0.1),
        ("mine", 0.2),
        ("ded-dpc-paper", 2.0),
        ("ded-dpc", 1.0),
        ("ed", None),
    ]
    rows = pd.DataFrame(cells, columns=["method", "gap_percent"]).assign(settings="default")
    assert challengers(rows, "ded") == ["ded-dpc", "ded-dpc-paper", "ded-ko", "mine"]
    assert challengers(rows[:1], "ded") == []
