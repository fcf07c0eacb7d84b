"""Which rows count, their lines, and how lines are named and ordered."""

from __future__ import annotations

import pandas as pd
import pytest

from ded_bench.analysis.summary import groups, judged_rows, main_lines, newest, on_usual_model, title
from ded_bench.methods.registry import METHODS
from tests.analysis.test_summary import frame_of, row


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (("ded",), "DED"),
        (("ded", "accelerated=on"), "DED [accelerated=on]"),
        (("ded-ko", "default", "koopman"), "DED-KO"),
        (("ded-ko", "default", "linear"), "DED-KO [linear]"),
        (("ded-slp", "knot_s=0.1", "own"), "DED (SLP) [knot_s=0.1, own]"),
        (("ded-rti", "reserve=on", "trajectory"), "DED (real-time iteration) [reserve=on]"),
        (("mine", "default", "own"), "mine [own]"),
    ],
)
def test_titles_name_what_differs_from_the_usual(line: tuple[str, ...], text: str) -> None:
    assert title(*line) == text


def test_groups_follow_the_registry_with_strangers_last() -> None:
    names = ["zebra", "aardvark", *reversed(METHODS)]
    rows = [row("a", name, 1.0) for name in names]
    rows += [row("a", "ded-dpc", 1.0, settings=f"refine={n}") for n in (100, 25)]
    rows += [row("a", "ded-ko", 1.0, model=f"{name}@1") for name in ("linear", "koopman")]
    order = [key for _, key, _ in groups(frame_of(*rows))]
    assert list(dict.fromkeys(method for method, *_ in order)) == [*METHODS, "aardvark", "zebra"]
    own = [key[1:] for key in order if key[0] in ("ded-ko", "ded-dpc")]
    assert own == [
        ("default", ""),
        ("default", "koopman"),
        ("default", "linear"),
        ("default", ""),
        ("refine=25", ""),
        ("refine=100", ""),
    ]


def test_only_test_rows_count_if_there_are_any() -> None:
    """And never those of validation instances."""
    mixed = frame_of(
        row("a", "ded", 1.0),
        row("b", "ded", 2.0, split="train"),
        row("c", "ed", 3.0, split="none"),
        row("v", "ded", 1.0, split="validation"),
    )
    assert judged_rows(mixed)["instance"].to_list() == ["a"]
    assert judged_rows(mixed[1:])["instance"].to_list() == ["b", "c"]
    assert judged_rows(mixed[3:]).empty


def test_the_newest_model_and_policy_count_and_of_time_limits_the_newest_row() -> None:
    frame = frame_of(
        row("a", "ded-ko", 1.0, model="koopman@old", date="2026-01"),
        row("b", "ded-ko", 1.0, model="koopman@old", date="2026-03"),
        row("a", "ded-ko", 2.0, model="koopman@new", date="2026-04"),
        row("a", "ded-ko", 3.0, model="linear@1", date="2026-01"),
        row("a", "ded", 5.0, date="2026-02", time_limit_s=1.0),
        row("a", "ded", 4.0, date="2026-01"),
    )
    rows, notes = newest(frame)
    assert rows["objective"].to_list() == [2.0, 3.0, 5.0]
    (note,) = notes
    assert note.startswith("2 rows of DED-KO TO are of an older model, policy or version and left out")
    assert "koopman@new" in note
    assert newest(frame[:0])[0].empty


def test_versions_of_a_method_do_not_mix() -> None:
    """Though the older one has more rows, and no model or policy tells them apart."""
    old = [row(name, "ded-slp", 1.0, date="2026-01", method_version=1) for name in "abc"]
    frame = frame_of(*old, row("a", "ded-slp", 2.0, date="2026-02", method_version=2))
    rows, notes = newest(frame)
    assert rows["objective"].to_list() == [2.0]
    assert len(notes) == 1


def test_beside_the_paper_the_usual_surrogate_stands_alone() -> None:
    frame = frame_of(
        *(row("a", "ded-ko", 1.0, model=f"{name}@1") for name in ("koopman", "linear")),
        row("a", "ded-ko-knots", 1.0, model="linear@1"),
        row("a", "ded", 1.0),
    )
    kept = on_usual_model(frame)[["method", "model"]].to_numpy().tolist()
    assert kept == [["ded-ko", "koopman"], ["ded-ko-knots", "linear"], ["ded", ""]]
    assert on_usual_model(frame[:0]).empty


def test_the_main_line_of_a_method_is_on_the_surrogate_of_most_grids() -> None:
    frame = frame_of(
        row("a", "ded-ko", 1.0, model="koopman@1", case="9bus"),
        *(row("a", "ded-ko", 1.0, model="trajectory@1", case=case) for case in ("9bus", "39bus")),
        row("a", "ed", 1.0, settings="every=1", case="9bus"),
        row("a", "ed", 1.0, case="9bus"),
        row("a", "mine", 1.0, settings="x=1", case="9bus"),
    )

    def chosen(rows: pd.DataFrame) -> list[list[str]]:
        return main_lines(rows)[["method", "settings", "model"]].drop_duplicates().to_numpy().tolist()

    others = [["ed", "default", ""], ["mine", "x=1", ""]]
    assert chosen(frame) == [["ded-ko", "default", "trajectory"], *others]
    assert chosen(frame[frame["case"] == "9bus"]) == [["ded-ko", "default", "koopman"], *others]
    assert chosen(frame[:0]) == []
