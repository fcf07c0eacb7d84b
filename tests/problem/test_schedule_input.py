"""Schedules as notebooks have them."""

from __future__ import annotations

import pandas as pd
import pytest

import ded_bench
from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule, as_schedule


def test_lists_and_frames_mean_what_arrays_mean(case: Case, quiet_instance, constant) -> None:
    """A trajectory's frame, which has more columns, too."""
    instance, regime = quiet_instance(case, horizon_s=0.1), next(iter(case.regimes))
    schedule = constant(instance, case.p_nominal)
    expected = ded_bench.score(instance, schedule, regime, case=case)
    columns = {"t": schedule.t} | {f"P_{g}": p for g, p in zip(case.generators, schedule.p.T, strict=True)}
    frame = pd.DataFrame(columns)[[*reversed(columns)]]
    trajectory = ded_bench.simulate(instance, frame, case=case).to_frame()
    for given in (Schedule([0, 0.1], schedule.p.tolist()), frame):
        assert ded_bench.score(instance, given, regime, case=case) == expected
    again = ded_bench.score(instance, trajectory, regime, case=case)
    assert again.objective == pytest.approx(expected.objective, rel=1e-12)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("mine.csv", "is a str; give a Schedule, or a data frame"),
        (pd.DataFrame({"t": [0, 1], "P_1": [1, 1]}), r"P_plant: one such column is needed \(found: t, P_1\)"),
        (Schedule([0, 1], [[1.0], [1.0, 2.0]]), "t, P: must be real numbers, a row for each time"),
        (Schedule([0, 1], [["a"], ["b"]]), "t, P: must be real numbers"),
        (Schedule([0, 1], [1.0, 2.0]), r"has the shape \(2,\), but needs \(2, 1\): a row per time"),
        (Schedule([0, 1], [[1j], [2.0]]), "must be real numbers, .*complex"),
    ],
)
def test_anything_else_is_refused_in_a_sentence(threebus: Case, given: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        as_schedule(given, threebus)
