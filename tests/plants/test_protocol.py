"""What every registered plant keeps: it is a value, rests where it should, and goes on from any state."""

from __future__ import annotations

import contextlib
import dataclasses
import pickle
import pkgutil

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import PLANTS, Plant, plant_of, simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule

SHIPPED = sorted(path.parent.name for path in SHIPPED_CASES.glob("*/case.json"))


def carried(case: Case) -> list[str]:
    """The plants for which a case has data."""
    kinds = []
    for kind in PLANTS:
        with contextlib.suppress(InputError):
            kinds.append(plant_of(case, kind).name)
    return kinds


@pytest.fixture(scope="module")
def plant(case) -> Plant:
    """Each case for tests on its own plant."""
    return plant_of(case)


def moving(case: Case) -> tuple[Instance, Schedule]:
    """An instance of 4 s that begins far from rest, and a schedule that bends at eight places."""
    instance = sample_instance(case, 31, 2).model_copy(update={"horizon_s": 4.0})
    omega = {bus: 0.1 * (-1) ** i for i, bus in enumerate(case.generators)}
    instance = instance.model_copy(update={"initial": instance.initial.model_copy(update={"omega": omega})})
    p = np.random.default_rng(2).uniform(case.p_min, case.p_max, (9, len(case.generators)))
    p[0] = instance.p_initial(case)
    return instance, Schedule(np.linspace(0.0, 4.0, 9), p)


def test_a_plant_is_a_value(plant, case):
    """Nothing of it can be set; sent to another process it is the same, and does the same to the last bit."""
    with pytest.raises(dataclasses.FrozenInstanceError):
        plant.case = case
    sent, (instance, schedule) = pickle.loads(pickle.dumps(plant)), moving(case)
    assert (sent.name, sent.fingerprint, sent.case) == (plant.name, plant.fingerprint, plant.case)
    assert len(plant.fingerprint) == 12
    runs = [simulate(case, instance, schedule, one) for one in (plant, plant, sent)]
    for run in runs[1:]:
        for name in ("omega", "p_set", "p_gen", "p_slack"):
            np.testing.assert_array_equal(getattr(run, name), getattr(runs[0], name))


@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name in SHIPPED for kind in carried(Case.load(name))]
)
def test_it_rests_at_an_equilibrium(name, kind, quiet_instance, constant):
    """Of nominal powers and loads, for a minute: within 1e-9 Hz."""
    case = Case.load(name)
    instance = quiet_instance(case, horizon_s=60.0)
    run = simulate(case, instance, constant(instance, case.p_nominal), plant_of(case, kind))
    assert np.abs(run.omega).max() < 2 * np.pi * 1e-9
    np.testing.assert_allclose(run.p_gen, run.p_set, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.p_slack, run.p_slack[0], rtol=0, atol=1e-8)


def test_in_pieces_it_does_what_it_does_at_once(plant, case):
    """To the last bit."""
    instance, schedule = moving(case)
    whole = simulate(case, instance, schedule, plant)
    p_load, state = instance.p_load(case), plant.initial(instance)
    for first, last in ((0, 1), (1, 137), (137, 137), (137, 400)):
        k = slice(first, last + 1)
        piece = plant.advance(state, whole.p_set[k], p_load[k], instance.dt_s)
        state = piece.end
        for name in ("omega", "p_gen", "p_slack"):
            np.testing.assert_array_equal(getattr(piece, name), getattr(whole, name)[k])


def test_what_is_observed_leads_to_the_same_state(plant, case, alter):
    """An instance that starts from it, far from any equilibrium, goes on as the trajectory does."""
    instance, schedule = moving(case)
    whole, p_load, k = simulate(case, instance, schedule, plant), instance.p_load(case), 137
    state = plant.advance(plant.initial(instance), whole.p_set[: k + 1], p_load[: k + 1], instance.dt_s).end
    grid = whole.t[k:] - whole.t[k]
    load = {
        bus: {"points": np.column_stack([grid, column]).tolist()}
        for bus, column in zip(case.loads, p_load[k:].T, strict=True)
    }
    initial = plant.observed(state).initial(case).model_dump()
    second = {"schema": "ded-bench/instance/2", "horizon_s": float(grid[-1])}
    rest = alter(instance, load=load, initial=initial, **second)
    part = simulate(case, rest, Schedule(rest.grid, whole.p_set[k:]), plant)
    np.testing.assert_allclose(part.omega, whole.omega[k:], rtol=0, atol=2e-9)
    np.testing.assert_allclose(part.p_slack, whole.p_slack[k:], rtol=0, atol=2e-9)


@pytest.mark.parametrize("kind", PLANTS)
def test_a_registered_plant_has_the_whole_protocol(kind):
    """Also what planning and drawing ask of it, which the toys of these tests need not have."""
    asked = {name for name in vars(Plant) if not name.startswith("_")}
    own = pkgutil.resolve_name(PLANTS[kind])
    assert asked <= set(dir(own)) | {field.name for field in dataclasses.fields(own)}


class Least:
    """What the protocol asks of a plant that is simulated, judged and operated, and no more."""

    name, fingerprint = "least", "0"

    def __init__(self, case: Case) -> None:
        self._plant = plant_of(case)

    def initial(self, instance):
        return self._plant.initial(instance)

    def advance(self, state, p_set, p_load, dt_s):
        return self._plant.advance(state, p_set, p_load, dt_s)

    def observed(self, state):
        return self._plant.observed(state)


def test_the_least_plant_is_simulated_and_judged(ninebus):
    instance, schedule = moving(ninebus)
    assert score(ninebus, instance, schedule, "TO", Least(ninebus)) == score(
        ninebus, instance, schedule, "TO"
    )
