"""Cases with machine models: what their files say, every way they can be wrong, and measured starts."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance

FILES = ("case.json", "network.json", "machines.json")


@pytest.fixture(scope="module")
def island() -> Case:
    return Case.load("two-area-agc")


@pytest.fixture
def folder(tmp_path: Path) -> Callable[..., Path]:
    """`folder(file, edit)`: the island's files, one of them edited; no manifest, no instances."""

    def copied(file: str = "case.json", edit: Callable[[dict], Any] = lambda data: None) -> Path:
        for name in FILES:
            shutil.copy(SHIPPED_CASES / "two-area-agc" / name, tmp_path / name)
        data = json.loads((tmp_path / file).read_text())
        edit(data)
        (tmp_path / file).write_text(json.dumps(data))
        return tmp_path

    return copied


def _set(path: str, value: object) -> Callable[[dict], None]:
    def edit(data: Any) -> None:
        *parents, last = path.split(".")
        for part in parents:
            data = data[int(part)] if isinstance(data, list) else data[part]
        data[last] = value

    return edit


def test_an_island_schedules_every_machine(island: Case, folder: Callable[..., Path]) -> None:
    """Names, limits and weights; a file beside the case is part of its identity."""
    assert (island.slack, island.generators, island.loads) == (None, ("1", "2", "3", "4"), ("7", "9"))
    assert island.priced == island.generators
    assert island.plant_name == "detailed"
    np.testing.assert_allclose(island.inertia, [117.0, 117.0, 111.15, 111.15], rtol=1e-15)
    np.testing.assert_array_equal(island.load_nominal, [-9.67, -17.67])
    np.testing.assert_array_equal(island.knot_times(60.0), np.arange(61.0))
    assert island.agc is not None
    assert island.agc.participation == dict.fromkeys("1234", 0.25)
    excess = island.transfer_excess(np.array([7.0, 8.0, 7.0, 7.0]), np.array([-9.0, -18.0]))
    np.testing.assert_allclose(excess, [1.0], rtol=1e-15)
    copy = Case.load(folder())
    assert copy == pickle.loads(pickle.dumps(island)) == island
    heavier = Case.load(folder("machines.json", _set("machines.0.h", 7.0)))
    assert heavier != island
    assert heavier.fingerprint != island.fingerprint
    with pytest.raises(InputError, match="case two-area-agc: schema: has no lossless network"):
        Network(island)
    with pytest.raises(InputError, match=r"regimes.TO: bounds the mean frequency"):
        island.omega_bound("TO")


def test_bounds_of_an_island(island: Case) -> None:
    """The mean at every time and, tighter, at the end; swings about it: each kind's largest excess."""
    bounds, mean = island.bounds("TO"), island.regimes["TO"]
    hz = np.array([[0.0] * 4, [0.01, 0.0, 0.0, 0.0], [0.002] * 4])
    share = 0.01 * 117.0 / 456.3
    found = bounds.excess_hz(2 * np.pi * hz)
    assert found["mean"] == pytest.approx(max(share, 0.002) - mean.mean_hz if share > mean.mean_hz else 0.0)
    assert found["relative"] == pytest.approx(0.01 - share - mean.relative_hz)
    assert found["end"] == pytest.approx(0.002 - mean.end_hz)


def test_an_infinite_machine_is_not_scheduled(folder: Callable[..., Path]) -> None:
    """case/3 with an infinite slack: bounds are on every frequency, and it may or may not be named."""

    def infinite(data: dict) -> None:
        data["plant"] |= {"slack": "infinite", "agc": None}
        data["regimes"] = {"TO": {"omega_hz": 0.001}}
        del data["transfers"]

    for edit in (infinite, lambda data: (infinite(data), data["machines"].pop("3"))):
        case = Case.load(folder("case.json", edit))
        assert (case.slack, case.generators) == ("3", ("1", "2", "4"))
        assert case.priced == ("3", "1", "2", "4")
        assert case.omega_bound("TO") == pytest.approx(2e-3 * np.pi)


@pytest.mark.parametrize("name", ["two-area", "39bus", "68bus", "140bus"])
def test_lossless_cases_have_machines_of_their_generators(name: str) -> None:
    """Generator g<name> is machine <name>; nothing of it is in the fingerprint, on which rows depend."""
    case = Case.load(name)
    assert case.machine_of(case.slack or "") == case.detailed.slack
    assert set(map(case.machine_of, case.priced)) == set(case.detailed.machines)
    own = Case.load(name)
    own._grid = None
    assert own.fingerprint == case.fingerprint
    assert own != case


@pytest.mark.parametrize(
    ("file", "path", "value", "field", "problem"),
    [
        ("case.json", "plant.kind", "lossless", "plant.kind", "'detailed'"),
        ("case.json", "plant.slack", "infinite", "plant", "agc: needs an island"),
        ("case.json", "plant.agc.participation", {"1": 0.5}, "plant.agc", "sum to 1"),
        ("case.json", "plant.agc.participation", {"9": 1.0}, "", "participation: there is no machine 9"),
        ("case.json", "plant.agc.period_s", 0.015, "", "period_s: must be a whole multiple of dt_s"),
        ("case.json", "machines.1.p_min", 9.0, "machines.1", "p_min must be below p_max"),
        ("case.json", "machines.5", {"p_nominal": 1.0, "p_min": 0.0, "p_max": 2.0}, "machines", "machine 5"),
        ("case.json", "loads.7", 9.67, "loads.7", "less than 0"),
        ("case.json", "loads.77", -1.0, "buses", "no bus 77"),
        ("case.json", "transfers.0.machines", ["x"], "", "transfers.area-1: there is no machine x"),
        ("case.json", "regimes.TO", {"omega_hz": 0.001}, "", "regimes.TO: must have mean_hz"),
        ("case.json", "regimes.TO.end_hz", None, "regimes.TO.end_hz", "valid number"),
        ("case.json", "buses", [], "buses", "unknown field"),
        ("network.json", "case", "two-area", "case", "is 'two-area', not 'two-area-agc'"),
        ("network.json", "slack_machine_bus", 3, "slack_machine_bus", "valid string"),
        ("network.json", "base_mva", 50.0, "", "base_mva: must be 100"),
        ("network.json", "buses.0.v", 0.0, "buses.0.v", "greater than"),
        ("network.json", "buses.0.id", "2", "", "same id"),
        ("network.json", "buses.0.qd", float("nan"), "buses.0.qd", "finite"),
        ("network.json", "lines.0.r", -0.1, "lines.0.r", "greater than"),
        ("network.json", "lines.0.x", 0.0, "lines.0", "without impedance"),
        ("network.json", "lines.0.tap", 0.0, "lines.0.tap", "greater than"),
        ("network.json", "lines.0.to", "99", "", "1-99 does not join two known buses"),
        ("network.json", "lines", [], "", "is not connected to bus 3"),
        ("machines.json", "f0_hz", 50.0, "f0_hz", "is 50, and the case's 60"),
        ("machines.json", "slack_machine_bus", "1", "slack_machine_bus", "another one"),
        ("machines.json", "slack_machine_bus", "9", "", "one machine is needed at bus 9"),
        ("machines.json", "machines.0.bus", "99", "machines.0.bus", "no bus 99"),
        ("machines.json", "machines.0.name", "2", "", "same name"),
        ("machines.json", "machines.0.share", 0.5, "", "shares at bus 1 do not sum to 1"),
        ("machines.json", "machines.0.model", "GENSAL", "machines.0", "must be one of GENROU, GENCLS"),
        ("machines.json", "machines.0.model", [], "machines.0", "must be one of GENROU, GENCLS"),
        ("machines.json", "machines.0.governor.t3", 1e-9, "machines.0.governor.t3", "greater than"),
        ("machines.json", "machines.0.h", 0.0, "machines.0.h", "greater than"),
        ("machines.json", "machines.0.mva", -900.0, "machines.0.mva", "greater than"),
        ("machines.json", "machines.0.xd1", 2.0, "machines.0", "xd: is below xd1"),
        ("machines.json", "machines.0.xl", 0.25, "machines.0", "xl: must be below xd2"),
        ("machines.json", "machines.0.Tq20", 0.0, "machines.0.Tq20", "greater than"),
        ("machines.json", "machines.0.exciter.model", "DC1A", "machines.0.exciter", "one of SEXS, IEEEX1"),
        ("machines.json", "machines.0.exciter.kf", 1.0, "machines.0.exciter.kf", "unknown field"),
        ("machines.json", "machines.0.exciter", None, "machines.0", "pss: needs an exciter"),
        ("machines.json", "machines.0.governor", None, "machines.0.governor", "an object"),
        ("machines.json", "machines.0.governor.r", 0.0, "machines.0.governor.r", "greater than"),
    ],
)
def test_wrong_files_are_refused(
    folder: Callable[..., Path], file: str, path: str, value: object, field: str, problem: str
) -> None:
    """Each error names the file, the field, and what is wrong with it."""
    place = folder(file, _set(path, value))
    with pytest.raises(InputError) as caught:
        Case.load(place)
    wrong = "network.json" if problem == "no bus 77" else file
    assert (caught.value.source, caught.value.field) == (str(place / wrong), field)
    assert problem in caught.value.problem


@pytest.mark.parametrize("name", ["network.json", "machines.json"])
def test_an_island_needs_its_files(folder: Callable[..., Path], name: str) -> None:
    place = folder()
    (place / name).unlink()
    with pytest.raises(InputError, match=f"{name}: cannot be read"):
        Case.load(place)


def _instance(case: Case, **initial: object) -> str:
    at_rest = {"power": dict.fromkeys(case.generators, 7.0), "omega": dict.fromkeys(case.generators, 0.0)}
    load = {bus: {"initial": -9.0, "start": 0.0, "duration": 0.0, "rate": 0.0} for bus in case.loads}
    data = {
        "schema": "ded-bench/instance/2",
        "id": "measured",
        "case": case.id,
        "seed": 0,
        "horizon_s": 60.0,
        "dt_s": 0.01,
        "cost": dict.fromkeys(case.generators, 0.5),
        "load": load,
        "initial": at_rest | initial,
    }
    return json.dumps(data)


def test_a_measured_start(island: Case) -> None:
    """Turbines' powers and secondary control, whose fields may be left out."""
    text = _instance(island, mechanical=dict.fromkeys("1234", 7.1), agc={"held_pu": 0.2})
    instance = parse_record(Instance, text, "measured.json")
    instance.check_case(island)
    np.testing.assert_array_equal(instance.mechanical_initial(island), [7.1] * 4)
    agc = instance.initial.agc
    assert agc is not None
    assert (agc.held_pu, agc.integral_rad, agc.next_s) == (0.2, 0.0, None)
    assert instance.cost_slack(island) == 0.0
    again = parse_record(Instance, instance.model_dump_json(by_alias=True), "again")
    assert again == instance


@pytest.mark.parametrize(
    ("case_name", "initial", "field"),
    [
        ("two-area-agc", {"mechanical": {"1": 7.0}}, "initial.mechanical.2"),
        ("two-area-agc", {"theta": dict.fromkeys("12345", 0.0)}, "initial.theta.5"),
        ("two-area-agc", {"agc": {"next_s": 4.5}}, "initial.agc.next_s"),
        ("two-area", {"mechanical": dict.fromkeys(("g1", "g2", "g4"), 7.0)}, "initial.mechanical"),
        ("two-area", {"agc": {}}, "initial.agc"),
    ],
)
def test_a_wrong_measured_start_is_refused(case_name: str, initial: dict, field: str) -> None:
    case = Case.load(case_name)
    data = json.loads(_instance(case, **initial))
    data["cost"] = dict.fromkeys(case.priced, 0.5)
    with pytest.raises(InputError) as caught:
        parse_record(Instance, json.dumps(data), "measured.json").check_case(case)
    assert caught.value.field == field
