"""The check of a case: closed forms on the chain, the scorer's own frequencies, and the command around it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from ded_bench.analysis.inspect_case import check_case, implausible, suggested_knots
from ded_bench.cli import main
from ded_bench.files.strict import write_record
from ded_bench.methods import ed
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instances


def test_the_chain_has_the_mode_of_a_spring_and_a_mass(threebus: Case) -> None:
    """Lines in series have stiffness b₁b₂/(b₁ + b₂) with b cos δ; ω² = k/m, damping ratio d/(2mω)."""
    found = check_case(threebus, 1)
    v = {bus.id: bus.v for bus in threebus.buses}
    b_slack = v["s"] * v["town"] / abs(complex(0.01, 0.12))
    b_plant = v["plant"] * v["town"] / 0.1
    across = np.arcsin([0.4 / b_slack, 0.6 / b_plant])
    k_slack, k_plant = np.array([b_slack, b_plant]) * np.cos(across)
    omega = np.sqrt(k_slack * k_plant / (k_slack + k_plant) / 2.0)
    assert found.frequency_hz == pytest.approx([omega / (2 * np.pi)], rel=1e-9)
    assert found.damping == pytest.approx([1.2 / (2 * 2.0 * omega)], rel=1e-9)
    assert found.nominal.angle_deg == pytest.approx(np.degrees(across.max()), rel=1e-9)
    assert found.nominal.p_slack == pytest.approx(0.4)


def test_static_dispatch_violates_where_the_scorer_says_so(case: Case) -> None:
    found = check_case(case, 6)
    assert (found.drawn, found.served, found.redrawn_loads) == (6, 6, 0)
    assert len(found.peak_hz["omega"]) == 6
    regime = min(case.regimes, key=case.omega_bound)
    bound = case.regimes[regime].omega_hz
    scores = [
        score(case, instance, ed.dispatch(case, instance, 60.0), regime)
        for instance in sample_instances(case, VALIDATION_SEED, 6)
    ]
    beyond = np.sort([s.freq_violation_hz for s in scores])
    np.testing.assert_allclose(np.maximum(found.peak_hz["omega"] - bound, 0.0), beyond, atol=1e-12)
    assert found.violating[regime] == np.mean(beyond > 0)


def test_draws_that_cannot_be_served_or_collapse_are_counted(threebus: Case, alter) -> None:
    lines = json.loads(threebus.model_dump_json(by_alias=True))["lines"]
    weak = alter(threebus, lines=[line | {"r": 0.0, "x": 1.45} for line in lines])
    found = check_case(weak, 40)
    assert 0 < found.served < 40
    assert len(found.peak_hz["omega"]) == found.served
    ranges = json.loads(threebus.model_dump_json(by_alias=True))["sampling"]
    wild = alter(threebus, sampling=ranges | {"omega_rad_per_s": [20.0, 30.0]})
    assert np.isinf(check_case(wild, 2).peak_hz["omega"]).tolist() == [False, True]


def test_an_island_has_its_modes_and_breaks_its_bounds_under_static_dispatch() -> None:
    """ANDES has, at the nominal point, 0.62 Hz with 8.6 % between areas, 0.10 Hz with 35 % of frequency."""
    found = check_case(Case.load("two-area-agc"), 4)
    modes = list(zip(found.frequency_hz, 100 * found.damping, strict=True))
    for frequency, damping in ((0.62, 8.6), (0.11, 35.0)):
        assert any(abs(f - frequency) < 5e-3 and abs(d - damping) < 0.5 for f, d in modes)
    assert found.nominal.p_slack is None
    assert found.peak_hz.keys() == {"mean", "relative", "end"}
    assert found.violating["TO"] == 1.0


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus", "68bus", "140bus"])
def test_shipped_cases_have_the_suggested_knots(name: str) -> None:
    """But for two, whose reasons docs/grids.md gives: the paper's 50 on 9 buses, and fewer on 140."""
    case = Case.load(name)
    network = Network(case)
    modes = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
    fastest = float(np.abs(modes).max() / (2 * np.pi))
    knots = suggested_knots(case, fastest)
    assert knots == {"9bus": 25, "140bus": 241}.get(name, case.n_knots)
    spacing = np.diff(case.knot_times(60.0)) / case.sampling.dt_s
    if case.knots:
        np.testing.assert_allclose(spacing, np.round(spacing), atol=1e-9)
        assert name == "140bus" or spacing.max() * case.sampling.dt_s <= 2 / 3 / fastest


@pytest.mark.parametrize(("fastest", "knots"), [(1e-9, 2), (1.0, 11), (2.0, 21), (1e9, 601)])
def test_knots_lie_on_the_grid_however_fast_the_mode(threebus: Case, fastest: float, knots: int) -> None:
    """Spacings of 6, 0.6, 0.3 and 0.01 s are the longest that divide 6 s and are short enough."""
    assert suggested_knots(threebus, fastest) == knots


def test_implausible_data_are_named(threebus: Case, alter) -> None:
    """Each by its bus or machine; a sound case has nothing to say."""
    found = check_case(threebus, 2)
    sound = dataclasses.replace(found, frequency_hz=np.array([1.0]), knots=3, violating={"NO": 0.5})
    machine = json.loads(threebus.model_dump_json(by_alias=True))["machines"]["plant"]
    slow = alter(
        threebus, machines={"plant": machine | {"m": 10.0 * machine["p_max"] / (np.pi * threebus.f0_hz)}}
    )
    assert list(implausible(slow, sound)) == []
    buses = json.loads(threebus.model_dump_json(by_alias=True))["buses"]
    for bus in buses:
        bus |= {"v": 1.3, "p_nominal": 0.4} if bus["id"] == "town" else {}
    machine |= {"p_nominal": machine["p_max"] + 0.1}
    strange = dataclasses.replace(
        found, frequency_hz=np.array([1.0, 7.0]), knots=1000, violating={"NO": 0.0, "TO": 1.0}
    )
    odd = alter(threebus, buses=buses, machines={"plant": machine})
    assert [line.split(":")[0] for line in implausible(odd, strange)] == [
        "loads that feed in, pu (a load that draws is negative)",
        "nominal powers beyond the machines' limits, pu",
        "|V| of buses, pu, outside 0.8 to 1.2",
        "inertia constants, s, outside 1 to 15",
        "modes, Hz, outside 0.1 to 3",
        "knots",
        "regime NO",
        "regime TO",
    ]


def test_the_command_checks_a_case(threebus: Case, alter, tmp_path: Path, capsys) -> None:
    """Exit code 0; 1 where the grid cannot work; 2 where the file is wrong."""
    write_record(threebus, tmp_path / "good" / "case.json")
    assert main(["cases", str(tmp_path / "good"), "--count", "3"]) == 0
    printed = capsys.readouterr().out
    found = check_case(threebus, 3)
    assert f"{found.frequency_hz[0]:.3f}" in printed
    assert "warning      inertia constants, s, outside 1 to 15: plant" in printed
    assert f"{found.peak_hz['omega'][-1]:.4g}" in printed
    assert "3 of 3 servable" in printed
    lines = json.loads(threebus.model_dump_json(by_alias=True))["lines"]
    for name, x, problem in (("dead", 100.0, "nominal powers"), ("weak", 1.65, "no instance can be served")):
        write_record(alter(threebus, lines=[e | {"x": x} for e in lines]), tmp_path / name / "case.json")
        assert main(["cases", str(tmp_path / name), "--count", "3"]) == 1
        assert problem in capsys.readouterr().err
    assert main(["cases", str(tmp_path / "nowhere")]) == 2
    assert "no such case" in capsys.readouterr().err
