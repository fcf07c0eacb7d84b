"""Scenarios: strict files, true loads and forecasts with known values, and a sampler that repeats itself."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record, read_record
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import Manifest, scenario_files, write_scenarios
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.sampling import FLUCTUATION, LOAD_RANGE, sample_scenario
from ded_bench.problem.scenario import QUALITIES, Scenario, load_scenarios

SHIPPED = ("9bus", "two-area", "39bus")
#: A load of the three-bus chain: a ramp in the past of t = 5, one announced wrongly, one that is not.
LOAD = {
    "initial": -1.0,
    "ramps": [
        {"start": 1.0, "duration": 2.0, "rate": 0.01, "announced_start": None, "announced_rate": None},
        {"start": 6.0, "duration": 1.0, "rate": -0.02, "announced_start": 6.5, "announced_rate": -0.03},
        {"start": 8.0, "duration": 1.0, "rate": 0.05, "announced_start": None, "announced_rate": None},
    ],
    "fluctuation": {"step_s": 0.5, "values": [0.001 * k for k in range(33)], "decay_s": 4.0},
}


@pytest.fixture(scope="module")
def known(threebus, quiet_instance):
    """A scenario of 10 s on the chain, whose loads have closed forms."""
    initial = json.loads(quiet_instance(threebus).initial.model_dump_json())
    return Scenario.model_validate_json(
        json.dumps(
            {
                "schema": "ded-bench/scenario/1",
                "id": "known",
                "case": threebus.id,
                "seed": [0],
                "duration_s": 10.0,
                "dt_s": 0.01,
                "cost": {bus: 0.5 for bus in (threebus.slack, *threebus.generators)},
                "initial": initial,
                "load": {threebus.loads[0]: LOAD},
            }
        )
    )


def test_true_load_is_ramps_and_fluctuation(known, threebus):
    """At 0, within the first ramp, between points of the fluctuation, and after all ramps."""
    known.check_case(threebus)
    times = np.array([0.0, 2.25, 10.0])
    wanted = [-1.0, -1.0 + 0.0125 + 0.0045, -1.0 + 0.02 - 0.02 + 0.05 + 0.02]
    np.testing.assert_allclose(known.p_load(threebus, times)[:, 0], wanted, atol=1e-15)


def expected(quality, t):
    """What the forecast of the known load at t = 5 must say at times t, by hand."""
    fluctuation = 0.01 * np.exp(-(t - 5) / 4)
    start, rate = {"announced": (6.5, -0.03), "worse": (8.0, -0.06)}[quality]
    return -1.0 + 0.02 + rate * np.clip(t - start, 0.0, 1.0) + fluctuation


@pytest.mark.parametrize("quality", ["announced", "worse"])
def test_forecast_has_begun_and_announced_ramps_and_a_decaying_fluctuation(known, threebus, quality):
    """Exact at its points, and between them linear, off by step²/8 of the exponential's curvature."""
    known_loads = forecast(known, threebus, quality, 5.0, 16.0)
    points = np.array([5.0, 5.5, 6.5, 7.5, 8.0, 9.0, 15.0, 16.0])
    np.testing.assert_allclose(known_loads.at(points)[:, 0], expected(quality, points), atol=1e-15)
    between = np.linspace(5.0, 16.0, 997)
    chord = 0.5**2 / 8 * 0.01 / 4**2
    assert np.abs(known_loads.at(between)[:, 0] - expected(quality, between)).max() <= chord * (1 + 1e-9)


def test_late_ramp_is_expected_at_once(known, threebus):
    """A ramp whose announced start has passed comes now, as long as it has not begun."""
    load = known.load[threebus.loads[0]]
    early = load.ramps[1].model_copy(update={"announced_start": 2.0})
    moved = load.model_copy(update={"ramps": (load.ramps[0], early, load.ramps[2])})
    scenario = known.model_copy(update={"load": {threebus.loads[0]: moved}})
    now = forecast(scenario, threebus, "announced", 5.0, 16.0).at(np.array([6.0]))[0, 0]
    assert now == pytest.approx(-1.0 + 0.02 - 0.03 + 0.01 * np.exp(-1 / 4), abs=1e-15)


def test_perfect_forecast_is_the_truth_and_persistence_the_present(known, threebus):
    """At every time, on a grid that hits no point."""
    times = np.linspace(5.0, 16.0, 997)
    perfect = forecast(known, threebus, "perfect", 5.0, 16.0).at(times)
    np.testing.assert_allclose(perfect, known.p_load(threebus, times), atol=1e-15)
    constant = forecast(known, threebus, "persistence", 5.0, 16.0).at(times)
    assert set(constant[:, 0]) == {-1.0 + 0.02 + 0.01}


@pytest.mark.parametrize("quality", QUALITIES)
def test_points_of_an_instance_are_the_forecast(known, threebus, quality):
    """Shifted to t = 0 at its start; every forecast begins with the present load."""
    loads = forecast(known, threebus, quality, 5.0, 16.0)
    assert loads.at(np.array([5.0])) == pytest.approx(known.p_load(threebus, np.array([5.0])), abs=1e-15)
    instance = loads.instance(7.31, 6.0, known.initial, "later")
    assert parse_record(Instance, instance.model_dump_json(by_alias=True), "it passes all checks") == instance
    (points,) = instance.load.values()
    times = np.linspace(0.0, 6.0, 601)
    np.testing.assert_allclose(points.at(times), loads.at(7.31 + times)[:, 0], atol=1e-14)
    assert points.points[-1][0] == 6.0
    for given in (points, LoadPoints.model_validate(points.model_dump())):
        with pytest.raises(ValueError, match="read-only"):
            given.points[0, 1] = 0.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("duration_s", 10.005),
        ("dt_s", 0.0),
        ("seed", [-1]),
        ("unknown", 1),
        ("load", {"other": LOAD}),
        ("case", "9bus"),
        ("duration_s", 11.0),  # the fluctuation ends before the horizon beyond it
        ("dt_s", 2.5),  # does not divide the horizon
    ],
)
def test_wrong_scenarios_are_refused(known, threebus, tmp_path, field, value):
    """Each in one line that names the file."""
    data = json.loads(known.model_dump_json(by_alias=True)) | {field: value}
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"scenario\.json"):
        load_scenarios([path], threebus)


def test_the_sampler_repeats_itself(case, tmp_path):
    """Byte for byte, into a folder that held others; another seed gives other numbers."""
    folders = [tmp_path / name for name in "ab"]
    write_scenarios(case, 3, 7, folders[1], servable, case.sampling.horizon_s)
    manifests = [write_scenarios(case, 2, 0, f, servable, case.sampling.horizon_s) for f in folders]
    written = [{p.name: p.read_bytes() for p in folder.iterdir()} for folder in folders]
    assert written[0] == written[1]
    assert len(written[0]) == 3
    assert manifests[0] == manifests[1]
    first, other = (sample_scenario(case, seed, 0, servable) for seed in (0, 1))
    assert first.cost != other.cost
    assert [s.id for s in load_scenarios(scenario_files(folders[0]), case)] == [
        f"{case.id}-s0000",
        f"{case.id}-s0001",
    ]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_are_what_the_contract_says(name):
    """Checksums; ranges, announcements and fluctuations as DESIGN's; loads that the power flow can serve."""
    folder, case = SHIPPED_CASES / name / "scenarios", Case.load(name)
    manifest = read_record(Manifest, folder / "MANIFEST.json")
    for file, digest in manifest.files.items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
    scenarios = load_scenarios(scenario_files(folder), case)
    assert {p.name for p in folder.iterdir()} == {*manifest.files, "MANIFEST.json"}
    assert [s.duration_s for s in scenarios] == [300.0] * 20
    loads = [load for s in scenarios for load in s.load.values()]
    ramps = [ramp for load in loads for ramp in load.ramps]
    assert all(len(load.ramps) == 6 for load in loads)  # one a minute, also beyond the end
    known = [r for r in ramps if r.announced_start is not None]
    assert 1 - len(known) / len(ramps) == pytest.approx(0.2, abs=4 * np.sqrt(0.16 / len(ramps)))
    errors = [r.announced_start - r.start for r in known if r.start > 8]
    assert np.std(errors) == pytest.approx(1.5, rel=0.2)
    assert np.std([r.announced_rate / r.rate - 1 for r in known]) == pytest.approx(0.15, rel=0.2)
    for scenario in scenarios:
        relative = scenario.p_load(case, np.arange(0.0, 360.0, 0.5)) / case.load_nominal
        assert np.abs(relative - 1).max() < LOAD_RANGE + 10 * FLUCTUATION
    spread = [
        np.std(load.fluctuation.values) / abs(nominal)
        for s in scenarios
        for load, nominal in zip((s.load[b] for b in case.loads), case.load_nominal, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(spread))) == pytest.approx(FLUCTUATION, rel=0.15)
    assert all(load.fluctuation.values[0] == 0 for load in loads)
    Network(case).initial_angles(scenarios[0].snapshot(case, 0.0))


def test_a_shipped_scenario_is_what_the_sampler_writes():
    """The first one of the smallest case, byte for byte."""
    drawn = sample_scenario(Case.load("9bus"), 0, 0, servable).model_dump_json(by_alias=True) + "\n"
    assert drawn == (SHIPPED_CASES / "9bus" / "scenarios" / "9bus-s0000.json").read_text()
