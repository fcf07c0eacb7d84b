"""The linearisation of an island at its nominal point, from an instance's own start."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import case_knots
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.surrogates.find import find_model, find_surrogate

HORIZON = 9.0


def away(case: Case, quiet_instance: Any, size: float) -> Instance:
    """Rests away from the nominal point; a load ramps, secondary control acts twice."""
    load = {
        bus: {"initial": p, "start": 0.0, "duration": 0.0, "rate": 0.0}
        for bus, p in zip(case.loads, (case.load_nominal * (1.0 + 0.02 * size)).tolist(), strict=True)
    }
    load["mill"] |= {"start": 1.13, "duration": 2.41, "rate": -0.1 * size}
    instance: Instance = plant_of(case).balanced(quiet_instance(case, horizon_s=HORIZON, load=load))
    return instance


def moved(case: Case, instance: Instance, size: float) -> Array:
    """Powers at the knots: two machines exchange power from 2 s to 5 s."""
    points = case_knots(case, instance)
    part = np.clip((instance.grid[points] - 2.0) / 3.0, 0.0, 1.0)
    change = np.zeros_like(case.p_nominal)
    change[:2] = 0.2 * size, -0.2 * size
    return instance.p_initial(case) + np.outer(part, change)


def test_it_answers_as_the_plant_to_first_order(island: Case, quiet_instance: Any) -> None:
    """A tenth of a change away from nominal leaves a hundredth of the error, AGC and start included."""
    surrogate, left = find_surrogate(island, "linear", []), []
    for size in (1.0, 0.1):
        instance = away(island, quiet_instance, size)
        points, powers = case_knots(island, instance), moved(island, instance, size)
        told = surrogate.along(instance, powers, points)
        found = simulate(island, instance, Schedule(instance.grid[points], powers))
        assert told.delivered is not None
        left.append(
            [np.abs(told.omega - found.omega).max(), np.abs(told.delivered.p_gen - found.p_gen).max()]
        )
        assert left[-1][0] < 0.05 * size * np.abs(found.omega).max()
    np.testing.assert_array_less(left[1], 0.015 * np.array(left[0]))


def test_its_maps_are_its_rollout(island: Case, quiet_instance: Any) -> None:
    """Runge-Kutta's maps with resets against exponentials: set-points move it as they do along the way."""
    surrogate, instance = find_surrogate(island, "linear", []), away(island, quiet_instance, 1.0)
    points, powers = case_knots(island, instance), moved(island, instance, 1.0)
    still = np.tile(instance.p_initial(island), (len(points), 1))
    rest, told = (surrogate.along(instance, p, points) for p in (still, powers))
    # Steps of the integrator that maps are made of leave 1e-6 of a frequency.
    np.testing.assert_allclose(
        rest.outputs(powers - still)[0], told.omega, atol=1e-6 * np.abs(told.omega).max()
    )


def test_it_rests_where_the_plant_rests(island: Case, quiet_instance: Any) -> None:
    instance = away(island, quiet_instance, 1.0)
    load = {bus: ramp.model_copy(update={"rate": 0.0}) for bus, ramp in instance.load.items()}
    instance, points = instance.model_copy(update={"load": load}), case_knots(island, instance)
    still = np.tile(instance.p_initial(island), (len(points), 1))
    told = find_surrogate(island, "linear", []).along(instance, still, points)
    assert np.abs(told.omega).max() < 2 * np.pi * 1e-9


def test_no_lifted_model_of_an_island_is_found(island: Case) -> None:
    for name, told in (("linear", "no K for all"), ("koopman", "use linear or trajectory")):
        with pytest.raises(InputError, match=told):
            find_model(island, name, [])
