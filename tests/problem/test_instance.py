"""Load ramps and the time grid of an instance."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance, LoadPoints, LoadRamp, check_plausible
from ded_bench.problem.sampling import sample_instance


@pytest.mark.parametrize("rate", [-0.03, 0.0, 0.02])
@pytest.mark.parametrize("duration", [0.0, 2.5, 20.0])
def test_load_ramp_follows_the_papers_three_branches(rate, duration):
    """Before, during and after the ramp; 20 s from t = 3 s ends beyond a horizon of 10 s."""
    ramp = LoadRamp(initial=-0.9, start=3.0, duration=duration, rate=rate)
    t = np.linspace(0.0, 10.0, 1001)
    branches = np.where(
        t <= 3.0, -0.9, np.where(t <= 3.0 + duration, -0.9 + rate * (t - 3.0), -0.9 + rate * duration)
    )
    np.testing.assert_allclose(ramp.at(t), branches, rtol=0, atol=1e-15)


def test_loads_come_in_the_order_of_the_case(case):
    """Column j of p_load is the j-th load bus, whatever the order in the file."""
    instance = sample_instance(case, 3, 4)
    p_load = instance.p_load(case)
    assert p_load.shape == (instance.steps + 1, len(case.loads))
    for column, bus in zip(p_load.T, case.loads, strict=True):
        ramp = instance.load[bus]
        by_hand = [
            ramp.initial + ramp.rate * min(max(t - ramp.start, 0.0), ramp.duration) for t in instance.grid
        ]
        np.testing.assert_allclose(column, by_hand, rtol=0, atol=1e-15)


def test_the_grid_has_one_point_more_than_steps(case, quiet_instance):
    """t_k = k dt from 0 to the horizon; a step that is no binary fraction still divides it."""
    instance = quiet_instance(case)
    assert len(instance.grid) == instance.steps + 1 == round(case.sampling.horizon_s / 0.01) + 1
    np.testing.assert_array_equal(instance.grid, [k * 0.01 for k in range(instance.steps + 1)])
    assert instance.grid[-1] == pytest.approx(case.sampling.horizon_s, abs=1e-12)
    assert quiet_instance(case, horizon_s=0.3, dt_s=0.1).steps == 3
    assert quiet_instance(case, horizon_s=7, dt_s=7).steps == 1


def test_a_shorter_horizon_is_a_whole_number_of_steps(case, quiet_instance):
    """30 s are 187.5 steps of 0.16 s."""
    instance = quiet_instance(case, horizon_s=48.0, dt_s=0.16)
    shorter = instance.until(30.0)
    assert shorter.horizon_s == shorter.grid[-1] == pytest.approx(30.0, abs=0.08 + 1e-9)
    assert instance.until(50.0) is instance


# instance/2.

POINTS = [[0.0, -0.9], [1.5, -0.9], [3.5, -0.96], [60.0, -0.96]]


def second(case, instance, **changes) -> str:
    """An instance's file as instance/2, with some loads given by points, or angles at t = 0."""
    data = json.loads(instance.model_dump_json(by_alias=True)) | {"schema": "ded-bench/instance/2"}
    data["load"] |= {bus: {"points": points} for bus, points in changes.get("points", {}).items()}
    if "theta" in changes:
        data["initial"]["theta"] = changes["theta"]
    return json.dumps(data)


def test_fingerprints_of_instance_1_are_what_they_always_were(ninebus, threebus):
    """Rows of results carry them."""
    assert [sample_instance(ninebus, 2022, i).fingerprint for i in (0, 7)] == ["4a5578c227d6", "a06fd9b927bd"]
    assert [sample_instance(threebus, 5, i).fingerprint for i in (0, 1)] == ["b1614654f712", "5a65e3c30ee0"]


def test_points_that_say_what_a_ramp_says_are_the_same_load():
    ramp = LoadRamp(initial=-0.9, start=1.5, duration=2.0, rate=-0.03)
    points = LoadPoints.model_validate({"points": POINTS})
    t = np.linspace(0.0, 60.0, 6001)
    np.testing.assert_allclose(points.at(t), ramp.at(t), rtol=0, atol=1e-15)
    assert points.kinks == ramp.kinks == (1.5, 3.5)
    assert LoadRamp(initial=-0.9, start=1.5, duration=2.0, rate=0.0).kinks == ()


def test_instance_2_reads_back_as_it_was_written(case, quiet_instance):
    """Points and ramps side by side; angles stand in the order of the case."""
    theta = {bus: 0.01 * i for i, bus in enumerate(reversed(case.generators))}
    text = second(case, quiet_instance(case), points={case.loads[0]: POINTS}, theta=theta)
    instance = parse_record(Instance, text, "second")
    assert json.loads(instance.model_dump_json(by_alias=True)) == json.loads(text)
    np.testing.assert_array_equal(instance.theta_initial(case), [theta[g] for g in case.generators])
    assert instance.p_load(case)[[0, 150, 250, 350], 0] == pytest.approx([-0.9, -0.9, -0.93, -0.96])


@pytest.mark.parametrize(
    ("points", "field", "problem"),
    [
        ([[0.0, -1.0]], "load.town.points", "at least 2"),
        ([[0.5, -1.0], [60.0, -1.0]], "load.town", "points: must start at t = 0"),
        ([[0.0, -1.0], [0.0, -1.1], [60.0, -1.0]], "load.town", "points: times must increase strictly"),
        ([[0.0, -1.0], [5.99, -1.0]], "", "load.town.points: must reach the horizon"),
        ([[0.0, -1.0], [60.0, "x"]], "load.town.points.1.1", "valid number"),
        ([[0.0, -1.0], [60.0]], "load.town.points.1.1", "field required"),
        ([[0.0, -1.0], [60.0, 1e300]], "load.town.points.1.1", "less than"),
        (None, "load.town.points", "valid array"),
    ],
)
def test_wrong_points_are_refused(threebus, quiet_instance, points, field, problem):
    with pytest.raises(InputError) as caught:
        parse_record(Instance, second(threebus, quiet_instance(threebus), points={"town": points}), "bad")
    assert caught.value.field == field
    assert problem in caught.value.problem


# Mistakes that no file format refuses.


def test_every_load_has_the_sign_of_the_case(case: Case, quiet_instance) -> None:
    """A feed-in among the loads is positive, and a mistake if negative."""
    good = quiet_instance(case)
    check_plausible(case, good, "good.json")
    for bus in case.loads:
        wrong = good.load[bus].model_copy(update={"initial": -good.load[bus].initial})
        bad = good.model_copy(update={"load": good.load | {bus: wrong}})
        with pytest.raises(InputError, match=rf"bad.json: load.{bus}: .* pu has the wrong sign"):
            check_plausible(case, bad, "bad.json")


@pytest.mark.parametrize("frequency", [60.0, 59.98, -6.3, 6.3])
def test_a_frequency_in_hertz_is_no_deviation(case: Case, quiet_instance, frequency: float) -> None:
    good = quiet_instance(case)
    first = case.generators[0]
    for value in (frequency, np.copysign(6.2, frequency)):
        initial = good.initial.model_copy(update={"omega": good.initial.omega | {first: float(value)}})
        changed = good.model_copy(update={"initial": initial})
        if abs(value) < 2 * np.pi:
            check_plausible(case, changed, "x.json")
        else:
            with pytest.raises(InputError, match=rf"initial.omega.{first}: .* give the deviation in rad/s"):
                check_plausible(case, changed, "x.json")
