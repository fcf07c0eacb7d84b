"""The condensed rollout: what the step-by-step rollout gives, at every point or at some."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.problem.case import Case
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instance
from ded_bench.surrogates.koopman import CondensedRollout, free_response, hat_functions
from ded_bench.surrogates.linear import linear_model

KNOTS = 7
HORIZON = 2.0
STRIDES = (1, 8)


def condensed_of(case: Case, stride: int) -> CondensedRollout:
    grid = np.arange(round(HORIZON / case.sampling.dt_s) + 1) * case.sampling.dt_s
    return CondensedRollout.make(linear_model(case), grid, np.linspace(0.0, HORIZON, KNOTS), stride)


@pytest.mark.parametrize("stride", STRIDES)
def test_it_equals_the_sequential_rollout(case: Case, stride: int) -> None:
    condensed, n_gen = condensed_of(case, stride), len(case.generators)
    model = condensed.model
    drawn = [sample_instance(case, KOOPMAN_SEED, i) for i in range(3)]
    instances = [i.model_copy(update={"horizon_s": HORIZON}) for i in drawn]
    powers = np.random.default_rng(3).uniform(case.p_min, case.p_max, (3, KNOTS, n_gen))
    p_load = np.stack([i.p_load(case) for i in instances])
    p_gen = hat_functions(instances[0].grid, condensed.knots) @ powers
    psi = model.initial(instances)
    inputs = np.concatenate([p_gen, p_load], axis=-1).swapaxes(0, 1)
    sequential = model.rollout(psi, inputs)[::stride, :, : n_gen + 1].transpose(1, 2, 0)
    forced = np.einsum("opx,bx->bop", condensed.gamma, powers.reshape(3, -1))
    np.testing.assert_allclose(free_response(model, psi, p_load, stride) + forced, sequential, atol=1e-11)
