"""Models that several tests of methods share."""

from __future__ import annotations

import pytest

from ded_bench.problem.case import Case
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import nominal_model


@pytest.fixture(scope="module")
def koopman(case: Case) -> Koopman:
    """The linearisation, starting from exact equilibria."""
    return nominal_model(case)
