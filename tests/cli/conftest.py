"""Files of the small benchmark folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule


@pytest.fixture
def instance_file(problem: Path) -> Path:
    return problem / "instances" / "threebus-0000.json"


@pytest.fixture
def schedule_file(instance_file: Path, threebus: Case, tmp_path: Path) -> Path:
    instance, case = Instance.load_file(instance_file)
    power = instance.p_initial(case)
    path = tmp_path / "mine.csv"
    Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power])).write(path, case.generators)
    return path
