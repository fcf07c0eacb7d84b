"""What learners are given: gradients against differences of the scorer, linear maps, arrays, no torch."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch

import ded_bench.learning
from ded_bench.files.errors import InputError
from ded_bench.learning import condense, cost_and_excess, linearise, simulate_many, simulated, split_arrays
from ded_bench.learning.casadi_expressions import casadi_model
from ded_bench.plants.plant import SimulationError, plant_of, servable
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from tests.conftest import CASE_FILES
from tests.detailed_cases import MIXED
from tests.lagged_plant import lagged, lagged_case  # noqa: F401
from tests.test_api import WITHOUT_TORCH

HORIZON_S = 8.0


def drawn(case: Case, index: int = 0, plant: str | None = None, horizon_s: float = HORIZON_S) -> Instance:
    """A training draw that the plant can carry at t = 0, cut short; secondary control acts inside."""
    for k in itertools.count(index):
        data = json.loads(sample_instance(case, 2_000_000, k, servable).model_dump_json(by_alias=True))
        instance = Instance.model_validate_json(json.dumps(data | {"horizon_s": horizon_s}))
        with contextlib.suppress(SimulationError):
            plant_of(case, plant).initial(instance)
            return instance
    raise AssertionError


def wandering(case: Case, instance: Instance, seed: int = 0) -> Schedule:
    """From P_0 up and down, at rows of which some are between grid points."""
    t = np.array([0.0, 1.0, 2.505, 4.0, 6.0, HORIZON_S])
    moves = np.random.default_rng(seed).uniform(-1, 1, (len(t), len(case.generators))) * case.ramp
    return Schedule(t, instance.p_initial(case) + moves * (t > 0)[:, None])


CASES = {
    "lossless": lambda: Case.load(CASE_FILES["fivemachine"].parent),
    "island": lambda: Case.load(MIXED),
    "lagged": lambda: lagged_case(Case.load(CASE_FILES["fivemachine"].parent)),
    "infinite": lambda: Case.load("two-area"),
}


@pytest.fixture(params=list(CASES))
def grid(request: pytest.FixtureRequest, lagged: None) -> tuple[Case, str]:  # noqa: F811
    case = CASES[request.param]()
    return case, "detailed" if request.param == "infinite" else case.plant_name


def test_gradients_are_differences_of_the_scorer(grid: tuple[Case, str]) -> None:
    """Of cost and largest excess along three directions, to 1e-4; values are the scorer's own."""
    case, name = grid
    plant, instance = plant_of(case, name), drawn(case, plant=name)
    schedule, regime = wandering(case, instance), min(case.regimes, key=lambda r: case.regimes[r].largest_hz)
    power = torch.tensor(schedule.p[None], requires_grad=True)
    values = cost_and_excess(case, [instance], schedule.t, power, regime, plant)
    verdict = score(case, instance, schedule, regime, plant)
    assert values[0].item() == pytest.approx(verdict.objective, rel=1e-12)
    assert values[1].item() == pytest.approx(verdict.freq_violation_hz, rel=1e-9)
    assert verdict.freq_violation_hz > 0.0  # else its gradient would say nothing
    for value, field in zip(values, ("objective", "freq_violation_hz"), strict=True):
        (gradient,) = torch.autograd.grad(value.sum(), power, retain_graph=True)
        for seed in range(3):
            direction = np.random.default_rng(seed).normal(size=schedule.p.shape)
            step, ends = 1e-4, []
            for sign in (-1, 1):
                moved = Schedule(schedule.t, schedule.p + sign * step * direction)
                ends.append(getattr(score(case, instance, moved, regime, plant), field))
            difference = (ends[1] - ends[0]) / (2 * step)
            size = float(gradient.norm()) * np.linalg.norm(direction) / np.sqrt(direction.size)
            assert float((gradient[0].numpy() * direction).sum()) == pytest.approx(
                difference, abs=1e-4 * size
            )


def test_the_condensed_map_is_the_linear_model(grid: tuple[Case, str]) -> None:
    """At its knots, for any change of the schedule."""
    case, name = grid
    plant, instance = plant_of(case, name), drawn(case, plant=name)
    schedule = wandering(case, instance)
    model = linearise(case, instance, schedule, plant, 0.5)
    found = condense(case, instance, schedule, plant, 0.5)
    change = np.random.default_rng(1).normal(size=schedule.p.shape)
    hats = np.stack([np.interp(found.t, schedule.t, column) for column in change.T], axis=1)
    omega, p_slack = model.outputs(hats)
    of_map = np.einsum("tikg,kg->ti", found.d_omega, change), np.einsum("tkg,kg->t", found.d_p_slack, change)
    np.testing.assert_allclose(found.omega + of_map[0], omega[model.points], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.p_slack + of_map[1], p_slack[model.points], rtol=1e-9, atol=1e-9)


def test_a_schedule_that_cannot_be_followed_spoils_no_batch() -> None:
    case = CASES["island"]()
    instances = [drawn(case, 0), drawn(case, 1)]
    t = np.array([0.0, HORIZON_S])
    power = torch.tensor(np.array([[i.p_initial(case)] * 2 for i in instances]))
    power[1, 1] += 1e3
    power.requires_grad_()
    omega, _, _ = simulated(case, instances, t, power)
    assert torch.isfinite(omega[0]).all()
    assert torch.isnan(omega[1]).all()
    torch.nansum(omega**2).backward()
    assert power.grad is not None
    assert power.grad[0].abs().max() > 0
    assert power.grad[1].abs().max() == 0
    with pytest.raises(InputError, match="power: has the shape"):
        simulated(case, instances, t, power[:, :, :-1])
    with pytest.raises(InputError, match="t: must end at the horizon"):
        simulated(case, instances, t / 2, power)


def test_a_split_is_arrays(problem) -> None:
    """In the order of its ids, in the case's order of generators and loads."""
    train, one = split_arrays(problem), split_arrays(problem, "test", times=np.array([0.0, 1.0]))
    case = train.case
    assert (len(train), len(one), one.load.shape) == (4, 1, (1, 2, len(case.loads)))
    assert [i.id for i in train.instances] == sorted(i.id for i in train.instances)
    instance = train.instances[2]
    np.testing.assert_array_equal(train.load[2], instance.p_load(case, train.t))
    np.testing.assert_array_equal(train.cost[2], instance.cost_gen(case))
    np.testing.assert_array_equal(train.p_initial[2], instance.p_initial(case))
    np.testing.assert_array_equal(train.omega_initial[2], instance.omega_initial(case))
    assert train.cost_slack[2] == instance.cost_slack(case)
    for times in ([0.0, np.nan], [-1.0, 1.0], [0.0, 1e3], 5.0):
        with pytest.raises(InputError, match="times: must be a row of numbers from 0 to"):
            split_arrays(problem, times=times)
    with pytest.raises(InputError, match="limit: must be at least 0"):
        split_arrays(problem, limit=-1)


@pytest.mark.parametrize("power", [torch.ones((1, 2, 1), dtype=torch.int64), np.ones((1, 2, 1))])
def test_powers_are_a_tensor_of_real_numbers(threebus: Case, quiet_instance, power) -> None:
    instance = quiet_instance(threebus, horizon_s=0.2)
    with pytest.raises(InputError, match="must be a tensor of floating point numbers"):
        cost_and_excess(threebus, [instance], np.array([0.0, 0.2]), power, "TO")


def test_intervals_threads_and_cases_that_there_are_not(
    threebus: Case, ninebus: Case, quiet_instance
) -> None:
    instance = quiet_instance(threebus, horizon_s=0.2)
    table = pd.DataFrame({"t": [0.0, 0.2], "P_plant": [0.6, 0.6]})
    assert linearise(threebus, instance, table).p_gen.shape[1] == 1  # a data frame is a schedule
    for interval_s in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="interval_s: must be above 0"):
            linearise(threebus, instance, table, interval_s=interval_s)
    with pytest.raises(InputError, match="threads: must be at least 1"):
        simulate_many([instance], [table], threebus, threads=0)
    with pytest.raises(InputError, match="is for case 'threebus', not '9bus'"):
        casadi_model(ninebus).start(instance)


def test_numpy_is_enough_but_for_gradients() -> None:
    names = "CondensedMap, SplitArrays, condense, linearise, simulate_many, split_arrays"
    code = (
        f"{WITHOUT_TORCH}from ded_bench.learning import {names}\nfrom ded_bench.learning import simulated\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1].endswith("needs PyTorch: pip install torch")
    assert "cannot import name" not in done.stderr
    for name in ded_bench.learning.__all__:
        assert getattr(ded_bench.learning, name).__name__ == name
