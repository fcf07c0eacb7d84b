"""The exported programs of a closed loop are those that were solved: another solver agrees."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, milp
from scipy.sparse import csc_matrix

from ded_bench.files.errors import InputError
from ded_bench.learning import export_programs
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import sample_scenario
from ded_bench.run.online.loop import LoopOptions
from ded_bench.solvers import linear_program


@pytest.mark.parametrize(
    ("method", "own"),
    [
        ("ded-slp", None),
        ("ded-ko", Settings("solver=highs", model="linear")),
        ("ded-ko", Settings("solver=ipopt", model="linear")),
        ("ded-ko-knots", Settings(model="trajectory")),
    ],
)
def test_another_solver_finds_the_claimed_objectives(
    method: str, own: Settings | None, threebus: Case, tmp_path: Path
) -> None:
    """Two plans, 1 s apart and 0.5 s late; c'x agrees to what PIQP's gap of 1e-7 leaves."""
    path, scenario = tmp_path / "programs.npz", sample_scenario(threebus, 4_000_007, 0, duration_s=2.0)
    n = export_programs(path, threebus, scenario, method, "NO", own, LoopOptions(latency_s=0.5))
    with np.load(path, allow_pickle=False) as file:
        data = dict(file)
    assert n == len(data["start_s"]) >= 2
    assert [t for t, _ in itertools.groupby(data["start_s"])] == [0.0, 1.5]
    for k in range(n):
        c, lower, upper, lb, ub, x = (data[f"{k}_{name}"] for name in ("c", "l", "u", "lb", "ub", "x"))
        a = csc_matrix(
            tuple(data[f"{k}_{name}"] for name in ("data", "indices", "indptr")), (len(lower), len(c))
        )
        found = milp(c, bounds=(lb, ub), constraints=LinearConstraint(a, lower, upper))
        assert found.fun == pytest.approx(data["objective"][k], rel=1e-6)
        assert c @ x == data["objective"][k]
        assert np.maximum(lower - a @ x, a @ x - upper).max() < 1e-6
    assert not linear_program.LISTENERS


def test_a_method_without_linear_programs_is_named(threebus: Case, tmp_path: Path) -> None:
    """No file is written."""
    scenario = sample_scenario(threebus, 4_000_007, 0, duration_s=1.0)
    with pytest.raises(InputError, match="ed: solves no linear programs"):
        export_programs(tmp_path / "none.npz", threebus, scenario, "ed", "NO")
    assert not list(tmp_path.iterdir())
