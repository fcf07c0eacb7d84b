"""Which method is a case's reference, and where its objectives come from."""

from __future__ import annotations

import pytest

from ded_bench.analysis.reference import choose_reference, read_paper
from ded_bench.analysis.summary import gaps
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.results.rows import Objective
from tests.analysis.test_summary import frame_of, row


def test_the_papers_reference_where_a_case_carries_its_numbers() -> None:
    paper = read_paper(SHIPPED_CASES / "9bus")
    rows = frame_of(row("a", "ded", 100.0), row("a", "ded-radau", 99.0), row("a", "ed", 110.0))
    found = choose_reference(rows, paper)
    assert (found.method, found.title, found.shipped) == ("ded", "DED", 0)
    assert gaps(rows, found.objectives)["gap_percent"].to_list() == pytest.approx([0.0, -1.0, 10.0])
    assert choose_reference(rows[:0], paper).method == "ded"


def test_an_accurate_method_elsewhere_whichever_has_scored_rows() -> None:
    ded, slp, radau = row("a", "ded", 100.0), row("a", "ded-slp", 50.0), row("b", "ded-radau", 60.0)
    coarse = row("b", "ded-radau", 60.0, settings="coarse")
    wrong = row("c", "ded-radau", 60.0, feasible=False)
    for rows, method in (
        ((ded, slp, radau), "ded-radau"),
        ((ded, slp, row("b", "ded-radau")), "ded-slp"),
        ((ded, slp, coarse), "ded-slp"),
        ((slp, radau, wrong), "ded-radau"),
        ((slp, wrong), "ded-slp"),
        ((row("a", "ded"),), "ded-radau"),
        ((), "ded-radau"),
    ):
        assert choose_reference(frame_of(*rows), None).method == method


def test_the_best_feasible_row_where_nobody_ran_it() -> None:
    """Of each instance; it says so, and what to run."""
    wrong = row("a", "ded", 80.0, feasible=False)
    found = choose_reference(frame_of(wrong, row("a", "ed", 100.0), row("b", "mine", 50.0)), None)
    assert (found.title, found.wanted) == ("the best feasible schedule", "ded-slp")
    assert found.objectives.to_dict() == {("a", "TO"): 100.0, ("b", "TO"): 50.0}


def test_shipped_objectives_stand_in_where_the_reference_was_not_run() -> None:
    """Not on c, which is of another version, nor on instances that only bear the same name."""
    versions = {"a": "1-x", "b": "1-x", "c": "0-old"}
    shipped = [
        Objective("grid", name, "TO", "ded-radau", 100.0 * place, versions[name])
        for place, name in enumerate("abc", start=1)
    ]
    here = {"problems_version": "1-x"}
    rows = frame_of(
        row("a", "ded-radau", 90.0, **here),
        row("a", "ed", 99.0, **here),
        row("b", "ed", 220.0, **here),
        row("c", "ed", 99.0, **here),
    )
    found = choose_reference(rows, None, shipped)
    assert (found.method, found.shipped) == ("ded-radau", 1)
    ours = gaps(rows, found.objectives).query("method == 'ed'").set_index("instance")["gap_percent"]
    assert ours.dropna().to_dict() == {"a": pytest.approx(10.0), "b": pytest.approx(10.0)}
    assert choose_reference(rows.query("method == 'ed'"), None, shipped).shipped == 2
    assert choose_reference(rows.assign(problems_version=""), None, shipped).shipped == 0
