"""AC data of cases: what is read, what fits a case, and what is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import SHIPPED_CASES, Case

GRIDS = sorted(path.parent.name for path in SHIPPED_CASES.glob("*/ac.json"))


def test_four_cases_have_ac_data() -> None:
    assert GRIDS == ["140bus", "39bus", "68bus", "two-area"]


@pytest.mark.parametrize("name", GRIDS)
def test_shipped_data_fit_their_case(name: str) -> None:
    """Machines in the case's order; E' behind x'd at the nominal point is the case's internal bus."""
    case, data = Case.load(name), AcCase.of(Case.load(name))
    volts = {bus.id: bus.v for bus in case.buses}
    shared = [machine.bus for machine in data.machines]
    for bus, machine in zip((*case.generators, case.slack), data.machines_of(case), strict=True):
        i = data.index[machine.bus]
        share = machine.share * complex(data.buses[i].pg, data.buses[i].qg)
        emf = data.voltage[i] + 1j * data.reactance(machine) * np.conj(share / data.voltage[i])
        assert abs(emf) == pytest.approx(volts[bus], abs=2e-4)
        assert bus.removeprefix("g").rstrip("ab") == machine.bus
        assert bus[-1].isdigit() == (shared.count(machine.bus) == 1)


def test_the_admittance_matrix_has_ratio_and_shift_at_the_from_side(data: Callable[..., AcCase]) -> None:
    """Closed form of one line: currents at both ends under given voltages."""
    found = data(lambda raw: None)
    line = found.lines[0]
    ratio = line.tap * np.exp(1j * np.deg2rad(line.shift_deg))
    i, j = found.index[line.from_bus], found.index[line.to_bus]
    behind = found.voltage[i] / ratio  # after the ideal transformer
    series = (behind - found.voltage[j]) / complex(line.r, line.x)
    at_from = (series + 0.5j * line.b * behind) / np.conj(ratio)
    at_to = -series + 0.5j * line.b * found.voltage[j]
    np.testing.assert_allclose(found.admittance @ found.voltage, [at_from, at_to], atol=1e-14)


@pytest.fixture
def data(tmp_path: Path) -> Callable[..., AcCase]:
    """`data(change)`: two buses, a phase-shifting transformer, solved here; `change` alters the raw data."""
    tap, shift, z, b = 1.05, 10.0, 0.01 + 0.1j, 0.2
    ratio = tap * np.exp(1j * np.deg2rad(shift))
    v = np.array([1.02 * np.exp(0.3j), 0.98])
    behind = v[0] / ratio
    series = (behind - v[1]) / z
    s = v * np.conj([(series + 0.5j * b * behind) / np.conj(ratio), -series + 0.5j * b * v[1]])
    bus = {"pd": 0.0, "qd": 0.0, "gs": 0.0, "bs": 0.0}
    raw = {
        "source": "made up",
        "base_mva": 100.0,
        "slack_machine_bus": "b",
        "buses": [
            {"id": i, "v": abs(x), "angle_deg": np.rad2deg(np.angle(x)), "pg": p.real, "qg": p.imag} | bus
            for i, x, p in zip("ab", v, s, strict=True)
        ],
        "lines": [{"from": "a", "to": "b", "r": z.real, "x": z.imag, "b": b, "tap": tap, "shift_deg": shift}],
        "machines": [{"bus": i, "mva": 200.0, "xd1": 0.3, "h": 5.0, "share": 1.0} for i in "ab"],
    }

    def make(change: Callable[[dict], object]) -> AcCase:
        altered = json.loads(json.dumps(raw))
        change(altered)
        return parse_record(AcCase, json.dumps(altered), "ac.json")

    return make


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda raw: raw.pop("lines"), "lines: field required"),
        (lambda raw: raw.update(lines=[]), "the power flow is off by"),
        (lambda raw: raw.update(remark=1), "remark: extra inputs are not permitted"),
        (lambda raw: raw["buses"][0].update(v=0.0), "buses.0.v"),
        (lambda raw: raw["buses"][0].update(v=1.1), "a: the power flow is off by"),
        (lambda raw: raw["buses"][0].update(bs=0.1), "a: the power flow is off by 0.1 pu here"),
        (lambda raw: raw["buses"][1].update(id="a"), "two buses have the same id"),
        (lambda raw: raw["lines"][0].update(to="c"), "a-c does not join two known buses"),
        (lambda raw: raw["lines"][0].update(x="0.1"), "lines.0.x"),
        (lambda raw: raw["lines"][0].update(tap=0.0), "lines.0.tap"),
        (lambda raw: raw["lines"][0].update(tap=1.0), "the power flow is off by"),
        (lambda raw: raw["machines"][0].update(bus="c"), "no bus c"),
        (lambda raw: raw["machines"][0].update(share=0.5), "shares at bus a do not sum to 1"),
        (lambda raw: raw.update(slack_machine_bus="c"), "exactly one machine must be there"),
        (lambda raw: raw.update(schema="ded-bench/ac/9"), "schema"),
    ],
)
def test_wrong_data_are_one_line_errors(
    change: Callable[[dict], object], said: str, data: Callable[..., AcCase]
) -> None:
    with pytest.raises(InputError) as caught:
        data(change)
    assert str(caught.value).startswith("ac.json: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda raw: raw["machines"][0].update(xd1=0.31), "none at bus 1 has the x'd of bus g1"),
        (lambda raw: raw["machines"][1].update(h=7.0), "h at bus 2 is not that of bus g2"),
        (lambda raw: raw.update(slack_machine_bus=4), "the case's slack is at 3"),
        (lambda raw: raw["machines"].pop(0), "none at bus 1 has the x'd of bus g1"),
    ],
)
def test_data_of_another_grid_are_refused(change: Callable[[dict], object], said: str) -> None:
    raw = json.loads((SHIPPED_CASES / "two-area" / "ac.json").read_text())
    change(raw)
    found = parse_record(AcCase, json.dumps(raw), "ac.json")
    with pytest.raises(InputError, match=said):
        found.machines_of(Case.load("two-area"))


def test_cases_without_ac_data(ninebus: Case, threebus: Case) -> None:
    for case in (ninebus, threebus):
        with pytest.raises(InputError, match=r"ac\.json: no such file: this case has no AC data"):
            AcCase.of(case)
    with pytest.raises(InputError, match="no such bus in the case"):
        AcCase.of(Case.load("two-area")).machines_of(ninebus)
    with pytest.raises(InputError, match=r"AC data of case 39bus: buses: bus \d+ of the case is missing"):
        AcCase.of(Case.load("two-area")).machines_of(Case.load("39bus"))
