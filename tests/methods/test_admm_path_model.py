"""The grid linearised along paths, for the shared policy: what swings fast, and what swings up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ded_bench.methods.admm.grid_response import FINE
from ded_bench.problem.case import Case
from tests.methods.test_dpc_shared import drawn, linearised, path_model


def test_path_is_averaged_before_the_network_is_asked(ninebus: Case) -> None:
    """A fast swing of the path leaves no trace at the knots."""
    model = path_model(ninebus, 60.0)
    outset = drawn(model, 2)
    x = model.respond(outset.start, outset, linearised(model, outset))[0]
    k = np.arange(x.shape[1])
    swing = 0.01 * np.cos(np.pi * k / FINE * 2)[None, :, None]
    swing[:, [0, -1]] = 0.0
    calm, swung = model.along(outset, x), model.along(outset, x + swing)
    np.testing.assert_allclose(swung.offset[:, FINE:-FINE], calm.offset[:, FINE:-FINE], atol=3e-3)


@pytest.mark.parametrize("far", [np.inf, np.nan, 1e300])
def test_a_path_without_end_is_not_served(case: Case, far: float) -> None:
    """A schedule under which the linearised grid swings up: nothing is raised, and the others are served."""
    model = path_model(case)
    outset = drawn(model, 3)
    slow = model.start_path(outset)
    expected = model.linearise(outset, slow).offset
    assert outset.served.all()
    slow[1, 5:] = far
    found = model.linearise(outset, slow)
    np.testing.assert_array_equal(outset.served, [True, False, True])
    assert all(np.isfinite(values).all() for values in dataclasses.astuple(found))
    np.testing.assert_array_equal(found.offset[[0, 2]], expected[[0, 2]])
