"""Models that several tests of methods share."""

from __future__ import annotations

import dataclasses

import pytest

from ded_bench.problem.case import Case
from ded_bench.surrogates.energy_form import injection_lift
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import linear_model


@pytest.fixture(scope="module")
def koopman(case: Case) -> Koopman:
    """The linearisation, starting from exact equilibria."""
    return dataclasses.replace(linear_model(case), lift=injection_lift(case))
