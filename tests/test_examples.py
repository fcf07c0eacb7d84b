"""The examples run, and do what they say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import ded_bench
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.problem.sampling import sample_instance

EXAMPLES = REPOSITORY / "examples"


def test_the_tour(tmp_path: Path) -> None:
    """Static dispatch breaks the tight bound, the other methods keep it, and a figure shows it."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, EXAMPLES / "tour.py"]
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    table = pd.read_csv(tmp_path / "results" / "tour" / "table.csv")
    feasible = table.groupby("method")["feasible"].all()
    assert feasible.to_dict() == {"ed": False, "ded-dpc": True, "ded-ko-knots": True, "ded-slp": True}
    assert (tmp_path / "results" / "tour" / "schedules.png").stat().st_size > 10_000


def test_dispatch_with_foresight(ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps bounds, ramps and P_0, and costs no more than static dispatch would without them."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import lookahead_dispatch

    instance = sample_instance(ninebus, 1_500_000, 0)
    schedule = lookahead_dispatch.solve(instance, "NO", ninebus)
    verdict = ded_bench.score(instance, schedule, "NO")
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) < 1e-8
