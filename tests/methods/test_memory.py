"""Programs too large for a worker's memory are refused by their size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from ded_bench.methods import ded, ded_ko, ded_radau, solution
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import sample_instance
from ded_bench.solvers.status import Status
from ded_bench.surrogates.linear import linear_model


def on_linear(case: Case, regime: str, settings: Settings) -> Solver:
    return ded_ko.prepare_with(case, linear_model(case), regime, settings)


PREPARED: list[Any] = [
    pytest.param(ded.prepare, "default", {"68bus", "140bus"}, id="ded"),
    pytest.param(ded.prepare, "accelerated=on", {"140bus"}, id="accelerated"),
    pytest.param(ded_radau.prepare, "default", {"140bus"}, id="ded-radau"),
    pytest.param(on_linear, "default", {"140bus"}, id="ded-ko"),
    pytest.param(on_linear, "solver=highs", {"68bus", "140bus"}, id="ded-ko-highs"),
    pytest.param(on_linear, "solver=ipopt", {"68bus", "140bus"}, id="ded-ko-ipopt"),
]
Prepare = Callable[[Case, str, Settings], Solver]


@pytest.mark.parametrize(("prepare", "settings", "refused"), PREPARED)
def test_what_is_too_large_is_refused(prepare: Prepare, settings: str, refused: set[str]) -> None:
    """By the size of the grid and of the horizon, before anything is made."""
    for name in refused:
        case = Case.load(name)
        refusal = prepare(case, "NO", Settings(settings))(sample_instance(case, 77, 0))
        assert (refusal.status, refusal.schedule) == (Status.FAILED, None)
        assert "GiB" in refusal.error


def test_what_the_reference_runs_hold_is_allowed() -> None:
    """`ded` on two-area and 39bus, `ded-radau` on 68bus."""
    for name in ("two-area", "39bus"):
        case = Case.load(name)
        assert ded.program_bytes(case, sample_instance(case, 77, 0)) <= solution.MAX_BYTES
    case = Case.load("68bus")
    instance = sample_instance(case, 77, 0)
    elements = ded_radau.element_count(case, instance, ded_radau.default_element(case))
    assert ded_radau.program_bytes(case, elements) <= solution.MAX_BYTES
