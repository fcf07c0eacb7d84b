"""An island in coarse steps against the plant itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.coarse import CoarsePlant
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

HORIZON = 8.0


@pytest.fixture
def instance(island: Case, quiet_instance: Any) -> Instance:
    """One load ramps, with kinks between coarse points."""
    load = {bus: {"initial": v, "start": 0.0, "duration": 0.0, "rate": 0.0} for bus, v in nominal(island)}
    load["mill"] |= {"start": 1.13, "duration": 2.41, "rate": -0.02}
    return quiet_instance(island, horizon_s=HORIZON, load=load)


def nominal(case: Case) -> list[tuple[str, float]]:
    return list(zip(case.loads, case.load_nominal.tolist(), strict=True))


def schedule(case: Case, size: float = 0.05) -> Schedule:
    """Two machines exchange power, one takes what the load draws."""
    powers = np.tile(case.p_nominal, (3, 1))
    powers[1:, 0] += size
    powers[1:, 1] -= size
    powers[2, 3] += 0.05
    return Schedule(np.array([0.0, 4.0, HORIZON]), powers)


def errors(case: Case, instance: Instance, spacing_s: float) -> tuple[Array, Array]:
    """Errors of frequencies (Hz) and of delivered powers (pu), at all points and machines."""
    exact = simulate(case, instance, schedule(case))
    coarse = CoarsePlant(plant_of(case).system, spacing_s)  # type: ignore[attr-defined]
    points = np.linspace(0.0, HORIZON, round(HORIZON / spacing_s) + 1)
    omega, delivered = coarse.follow(coarse.begin(instance), schedule(case).at(points))
    every = round(spacing_s / instance.dt_s)
    return (omega - exact.omega[::every]) / (2 * np.pi), delivered - exact.p_gen[::every]


def test_coarse_steps_follow_the_plant(island: Case, instance: Instance) -> None:
    """Steps of a quarter of a second err by a hundredth of what happens, and by far less in shorter ones."""
    peak = np.abs(simulate(island, instance, schedule(island)).omega).max() / (2 * np.pi)
    omega, delivered = errors(island, instance, 0.25)
    finer, _ = errors(island, instance, 0.05)
    assert np.abs(omega).max() < 0.02 * peak
    assert np.abs(delivered).max() < 1e-4
    assert np.abs(finer).max() < np.abs(omega).max() / 8  # of second order: a fifth of the step, 1/25


def test_the_linear_answer_is_that_of_small_changes(island: Case, quiet_instance: Any) -> None:
    """Set-points that move a little from the nominal equilibrium, AGC included."""
    coarse = CoarsePlant(plant_of(island).system, 0.2)  # type: ignore[attr-defined]
    points = np.linspace(0.0, HORIZON, 41)
    change = 1e-4 * (schedule(island).at(points) - island.p_nominal)
    begun = coarse.begin(quiet_instance(island, horizon_s=HORIZON))
    still, moved = (coarse.follow(begun, island.p_nominal + d)[0] for d in (0.0 * change, change))
    linear = coarse.response(change[:, :, None])[0][:, :, 0]
    # What N has of second order is of the size of the change.
    np.testing.assert_allclose(moved - still, linear, atol=1e-3 * np.abs(linear).max())


def test_agc_between_steps_is_refused(island: Case, instance: Instance) -> None:
    with pytest.raises(InputError, match="acts between steps"):
        _ = CoarsePlant(plant_of(island).system, 0.3).maps  # type: ignore[attr-defined]
