"""Which code, models and policies made the rows: per method, and where they differ."""

from __future__ import annotations

from typing import Any

import pandas as pd

from ded_bench.methods.registry import METHODS
from ded_bench.report.provenance import provenance, provenance_notes
from ded_bench.run.code import code_of, code_of_method
from tests.evaluate.test_summary import frame_of
from tests.evaluate.test_summary import row as plain_row

SCORER = code_of("ded_bench.plants.score")
COLUMNS = ["regime", "method", "settings", "code", "model", "policy"]


def row(instance: str, method: str, **fields: Any) -> Any:
    """A row that the code installed here has made."""
    made = {
        "code": code_of_method(METHODS[method], fields.get("settings", "default")),
        "score_code": SCORER,
    } | fields
    return plain_row(instance, method, 1.0, **made)


def timing(*rows: tuple[str, ...]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=COLUMNS)


DED = code_of_method(METHODS["ded"], "default")


def test_rows_of_one_making_need_no_note() -> None:
    frame = frame_of(row("a", "ded"), row("b", "ded"), row("a", "ded-dpc", policy="ded-dpc@123"))
    policy = ("TO", "ded-dpc", "default", code_of_method(METHODS["ded-dpc"], "default"), "", "ded-dpc 123")
    times = timing(("TO", "ded", "default", DED, "", ""), policy)
    assert provenance_notes(frame, times) == []
    table = provenance(frame, times).set_index("method")
    assert table.loc["ded", ["rows", "code", "score_code", "timed_code"]].to_list() == [2, DED, SCORER, DED]
    assert table.loc["ded-dpc", "policy"] == "ded-dpc 123"


def test_different_code_within_a_method_is_said_across_regimes() -> None:
    frame = frame_of(row("a", "ded"), row("a", "ded", regime="NO", code="0ld", score_code="0lder"))
    first, second, third, fourth = provenance_notes(frame, timing())
    assert f"DED ({DED} × 1, 0ld × 1)" in first
    assert f"scored by different code ({SCORER} × 1, 0lder × 1)" in second
    assert "other code than what is installed here: DED." in third
    assert "scored by other code" in fourth


def test_methods_have_code_of_their_own() -> None:
    """Different hashes of different methods are no difference."""
    assert provenance_notes(frame_of(row("a", "ded"), row("a", "ed")), timing()) == []
    stranger = plain_row("a", "mine", 1.0, code="abc", score_code=SCORER)
    assert provenance_notes(frame_of(stranger), timing()) == []


def test_settings_that_another_module_answers_have_code_of_their_own() -> None:
    """Those of `ded` that start from DED-KO depend on more than its default does."""
    start, default = (code_of_method(METHODS["ded"], slug) for slug in ("start-ko", "default"))
    assert start != default
    frame = frame_of(row("a", "ded"), row("a", "ded", settings="start-ko"))
    assert provenance_notes(frame, timing()) == []
    wrong = frame_of(row("a", "ded", settings="start-ko", code=default))
    assert provenance_notes(wrong, timing()) == [
        "Rows come from other code than what is installed here: DED."
    ]


def test_rows_without_code_and_mixed_policies_are_counted() -> None:
    mixed = [
        row(name, "ded-dpc", policy=f"ded-dpc@{digit}") for name, digit in (("a", 1), ("b", 2), ("c", 2))
    ]
    frame = frame_of(*mixed, row("a", "ed", code=""))
    unknown, policies = provenance_notes(frame, timing())
    assert unknown == "1 rows do not say which code made them: ED."
    assert "different policies: DED-DPC TO (ded-dpc 2 × 2, ded-dpc 1 × 1)" in policies


def test_times_of_other_code_or_another_policy_are_named() -> None:
    frame = frame_of(row("a", "ded", model="koopman@1"))
    assert provenance_notes(frame, timing(("TO", "ded", "default", "0ld", "koopman 2", ""))) == [
        "Times were taken with another code than the rows were made with: DED TO.",
        "Times were taken with another model than the rows were made with: DED TO.",
    ]


def test_failures_were_made_by_nothing() -> None:
    frame = frame_of(row("a", "ded"), plain_row("b", "ded"))
    assert provenance_notes(frame, timing()) == []
    assert provenance(frame_of(), timing()).empty
