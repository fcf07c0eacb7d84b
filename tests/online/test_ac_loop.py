"""The loop on the full AC network: its plant is that of `simulate_ac`, rows say which truth they are of."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ded_bench.cli import main
from ded_bench.methods.solution import Settings
from ded_bench.online.ac_plant import AcPlant
from ded_bench.online.hindsight import whole_instance
from ded_bench.online.loop import LoopOptions, run_loop
from ded_bench.online.online_results import ONLINE, OnlineResults
from ded_bench.online.online_summary import online_rows
from ded_bench.online.operation import make_operations
from ded_bench.online.planner import Plan
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.benchmark import problem_folder
from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Scenario, load_scenarios
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.ac_simulate import simulate_ac
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import SimulationError

TWO_AREA = Case.load("two-area")
DATA = AcCase.of(TWO_AREA)
SCENARIOS = problem_folder("two-area", TWO_AREA) / "scenarios"
#: The first scenarios with and without an AC equilibrium at t = 0.
CARRIED, NOT_CARRIED = "two-area-s0004", "two-area-s0000"


def short(name: str, duration_s: float = 6.0) -> Scenario:
    """The beginning of a shipped scenario."""
    [scenario] = load_scenarios([SCENARIOS / f"{name}.json"], TWO_AREA)
    return scenario.model_copy(update={"duration_s": duration_s})


def onward(instance, last):
    """Plans that keep the powers of the state."""
    power = instance.p_initial(TWO_AREA)
    return Plan(Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power])))


def test_pieces_are_the_whole_simulation():
    """Twelve pieces of half a second, to the tolerance of voltages at their starts."""
    scenario = short(CARRIED)
    plant = AcPlant(TWO_AREA, scenario, DATA, lossless_angles=False)
    outcome = run_loop(TWO_AREA, scenario, onward, LoopOptions(period_s=0.5), plant)
    power = outcome.trajectory.p_gen[[0, -1]]
    instance = whole_instance(TWO_AREA, scenario)
    whole = simulate_ac(TWO_AREA, DATA, instance, Schedule(np.array([0.0, 6.0]), power))
    assert (outcome.plans, outcome.failed) == (12, 0)
    np.testing.assert_allclose(outcome.trajectory.omega, whole.omega, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outcome.trajectory.p_slack, whole.p_slack, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lossless", [False, True])
def test_what_methods_are_told(lossless):
    """Angles of E', or those at which the lossless network delivers the same electrical powers."""
    scenario, told = short(CARRIED, 2.0), []

    def ask(instance, last):
        told.append(instance)
        return onward(instance, last)

    plant = AcPlant(TWO_AREA, scenario, DATA, lossless)
    trajectory = run_loop(TWO_AREA, scenario, ask, LoopOptions(), plant).trajectory
    network, grid = AcNetwork(TWO_AREA, DATA), Network(TWO_AREA)
    for instance, k in zip(told, (0, 100), strict=True):
        theta = trajectory.theta[k, grid.generators]
        if not lossless:
            assert np.array_equal(instance.theta_initial(TWO_AREA), theta)
            continue
        load = trajectory.p_load[k]
        power = network.operating_point(theta, network.active(load)).power[:-1]
        assert np.abs(instance.theta_initial(TWO_AREA) - theta).max() > 1e-3
        delivered = grid.injections(grid.initial_angles(instance))[grid.generators]
        assert delivered == pytest.approx(power, abs=1e-8)


def test_scenarios_without_an_equilibrium():
    with pytest.raises(SimulationError, match="no initial AC equilibrium"):
        AcPlant(TWO_AREA, short(NOT_CARRIED), DATA, lossless_angles=True)


def test_angles_by_what_plans_stand_on():
    def of(method, settings):
        chosen = [(method, settings)]
        options = LoopOptions()
        (o,) = make_operations(TWO_AREA, [short(CARRIED)], chosen, ["TO"], options, "0", [], data=DATA)
        return o.plans_on_ac, o.truth

    assert of("ded-slp", Settings("ac")) == (True, "ac")
    assert of("ded-slp", Settings()) == (False, "ac")
    assert of("ded-ko-knots", Settings(model="trajectory-ac")) == (True, "ac")
    assert of("ded-ko-knots", Settings(model="trajectory")) == (False, "ac")


def test_rows_of_two_truths(tmp_path, capsys):
    """One row that says why there is none, one beside that of the lossless network, and a hindsight each."""
    files = []
    for name in (NOT_CARRIED, CARRIED):
        text = (SCENARIOS / f"{name}.json").read_text()
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(json.loads(text) | {"duration_s": 2.0}))
        files.append(str(path))
    what = f"--case two-area --method ed --settings 1s --regime TO --latency zero --out {tmp_path / 'out'}"
    base = ["online", *what.split(), "--scenario"]
    assert main([*base, *files, "--truth", "ac"]) == 1
    assert "no initial AC equilibrium" in capsys.readouterr().out
    assert main([*base, files[1]]) == 0
    results = OnlineResults(tmp_path / "out")
    bad, good, lossless = results.table.rows.values()
    assert (bad.truth, good.truth, lossless.truth) == ("ac", "ac", "paper")
    assert bad.objective is None
    assert good.objective != lossless.objective
    assert [row.truth for row in results.hindsight.rows.values()].count("ac") == 2
    assert results.hindsight.rows[CARRIED, "TO", "ac"].method == "ded-slp ac"
    assert good.increase_percent is not None
    assert len(online_rows(results, "two-area")) == 1
    assert online_rows(results, "two-area", "ac")["scenario"].tolist() == [NOT_CARRIED, CARRIED]


def test_tables_without_the_column_stay_readable(tmp_path):
    """Their rows are of the lossless network."""
    path = tmp_path / "online.csv"
    names = "scenario,regime,method,settings,period_s,latency_s,forecast,predicted,warm"
    path.write_text(f"{names}\ns,TO,ed,1s,1.0,0.0,announced,True,True\n")
    [row] = ONLINE.read(path)
    assert row.truth == "paper"
