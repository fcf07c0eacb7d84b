"""The loop on islands: states with secondary control are handed on, planners can use them, rows repeat."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest

from ded_bench.cli import main
from ded_bench.files.arrays import read_arrays
from ded_bench.files.strict import read_record, write_atomically
from ded_bench.methods import ed
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE
from ded_bench.plants.detailed.static_dispatch import StaticDispatch
from ded_bench.plants.plant import plant_of, servable, simulate
from ded_bench.problem.benchmark import Manifest, scenario_files
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import AgcState, Instance
from ded_bench.problem.sampling import DRIFT, HOUR_RANGE, HOUR_S, sample_scenario
from ded_bench.problem.scenario import Scenario, load_scenarios
from ded_bench.problem.schedule import Schedule
from ded_bench.results.online_results import OnlineResults
from ded_bench.run.online.judgement import EPSILON_HZ, cps1, hindsight, judge_operation, whole_instance
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from ded_bench.run.online.operation import make_operations, operate
from ded_bench.solvers.status import Status
from tests.detailed_cases import MIXED

AGC_CASES = ("two-area-agc", "39bus-agc", "68bus-agc", "140bus-agc")


@pytest.fixture(scope="module")
def scenario(island) -> Scenario:
    """More than a horizon of it."""
    return sample_scenario(island, 0, 0, servable, 26.0)


class Follow:
    """Answers with one schedule of the whole scenario, and keeps what was asked."""

    def __init__(self, schedule: Schedule) -> None:
        self.schedule, self.instances = schedule, list[Instance]()

    def __call__(self, instance: Instance, last: Schedule | None) -> Planned:
        self.instances.append(instance)
        start = int(instance.id.rsplit("-", 1)[1]) * instance.dt_s
        inside = self.schedule.t - start
        inside = inside[(inside > 1e-6) & (inside < instance.horizon_s - 1e-6)]
        times = np.concatenate([[0.0], inside, [instance.horizon_s]])
        return Planned(Schedule(times, self.schedule.at(times + start)))


@pytest.fixture(scope="module")
def followed(island, scenario) -> tuple[Follow, dict[str, np.ndarray]]:
    """Plans every second, known 0.37 s later, that are always the same; and what came of them."""
    whole = whole_instance(island, scenario)
    ask = Follow(ed.dispatch(island, whole, 10.0))
    found = run_loop(island, scenario, ask, LoopOptions(latency_s=0.37, forecast="perfect")).trajectory
    wanted = simulate(island, whole, ask.schedule)
    return ask, {"found": found, "wanted": wanted}


def test_unchanged_plans_are_one_long_simulation(followed):
    """Frequencies, turbines, and secondary control, whose times are no ends of plans."""
    found, wanted = followed[1]["found"], followed[1]["wanted"]
    for name in ("omega", "p_set", "p_gen"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.columns["agc"], wanted.columns["agc"], rtol=0, atol=1e-9)
    assert np.flatnonzero(np.diff(found.columns["agc"])).tolist() == list(range(199, 2599, 200))


def test_what_planners_are_told_is_an_instance_that_they_solve(island, followed, tmp_path):
    """A state in the middle, two thirds of a second from the next action: from a file, by every planner."""
    ask, runs = followed
    instance, k = ask.instances[7], int(ask.instances[7].id.rsplit("-", 1)[1])
    path = tmp_path / "instances" / "measured.json"
    write_atomically(path, instance.model_dump_json(by_alias=True, exclude_none=True))
    read, _ = Instance.load_file(path, island)
    agc = read.initial.agc
    assert agc is not None
    assert agc.held_pu == pytest.approx(runs["wanted"].columns["agc"][k], abs=1e-9)
    assert agc.next_s == pytest.approx((-k % 200) * 0.01, abs=1e-12)
    np.testing.assert_allclose(read.mechanical_initial(island), runs["wanted"].p_gen[k], rtol=0, atol=1e-9)
    for name, options in (
        *(("ed", text) for text in ("default", "every=1", "every=60", "every=300", "lead=on")),
        *(("ded-rti", "default"), ("ded-slp", "default")),
    ):
        solver = get_method(name).prepare(island, "NO", Settings(options))
        operate_on = getattr(solver, "solve", solver)
        solution: Solution = operate_on(read)
        assert solution.schedule is not None, (name, options, solution.error)
        simulate(island, read, solution.schedule)


@pytest.mark.parametrize("due", [False, True])
def test_dispatch_leaves_to_secondary_control_what_it_holds(island, quiet_instance, due):
    """Set-points and shares together balance loads and losses; an action that is due counts."""
    agc = AgcState(held_pu=0.07, integral_rad=2.0 if due else 0.0, next_s=0.0 if due else 1.5)
    instance = quiet_instance(island, schema="ded-bench/instance/2")
    instance = instance.model_copy(update={"initial": instance.initial.model_copy(update={"agc": agc})})
    power = ed.dispatch(island, instance, 5.0).p[-1]
    held = -0.05 * 2.0 if due else 0.07
    system = plant_of(island).system
    share = held * np.array([island.agc.participation.get(name, 0.0) for name in island.generators])
    weighed = StaticDispatch(system).weigh(power + share, island.load_nominal)
    assert weighed.short == pytest.approx(0.0, abs=1e-6)
    without = StaticDispatch(system).weigh(power, island.load_nominal)
    assert without.short == pytest.approx(held, rel=0.1)


def test_practice_gets_a_forecast_as_long_as_its_interval(island, scenario, tmp_path):
    """Every answer is asked for once an interval, and told the loads up to its end."""
    settings = get_method("ed").canonical(Settings("every=25"))
    (made,) = make_operations(
        island, [scenario], ("ed", settings), ["TO"], LoopOptions(25.0), "zero", plant="detailed"
    )
    assert made.options.horizon_s == 25.0
    ask = Follow(ed.dispatch(island, whole_instance(island, scenario), 25.0))
    run_loop(island, scenario, ask, made.options)
    assert [i.horizon_s for i in ask.instances] == [25.0, 25.0]
    ends = [load.points[-1][0] for load in ask.instances[0].load.values()]
    assert ends == [25.0] * len(island.loads)


def test_minutes_of_known_frequency_have_a_known_cps1():
    """ε in every minute: 100; nothing: 200; half of the minutes at 2 ε: 0; what is short is a minute."""
    t = np.arange(0, 24001) * 0.01
    assert cps1(t, np.zeros(len(t))) == 200.0
    assert cps1(t, np.full(len(t), -EPSILON_HZ)) == pytest.approx(100.0)
    half = np.where((t // 60) % 2 == 0, 2 * EPSILON_HZ, 0.0)
    assert cps1(t, half) == pytest.approx(0.0, abs=0.02)  # one point of four minutes more
    quick = EPSILON_HZ * np.sin(2 * np.pi * t / 60)  # its means vanish
    assert cps1(t, quick) == pytest.approx(200.0, abs=1e-5)
    assert cps1(t[:1001], np.full(1001, EPSILON_HZ)) == pytest.approx(100.0)
    last = np.where(t >= 120.0, 2 * EPSILON_HZ, 0.0)[:15001]  # half a minute is the third
    assert cps1(t[:15001], last) == pytest.approx(100 * (2 - 4 / 3), abs=0.02)


def test_hindsight_keeps_the_bounds_and_costs_no_more_than_who_keeps_them(island, scenario):
    """Against plans every 5 s with perfect forecasts."""
    _, best, _ = hindsight(island, scenario, "NO")
    assert best.max_excess_hz < 1e-5
    solver = get_method("ded-rti").prepare(island, "NO", Settings())

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        return Planned(solver.solve(instance, last and Solution(Status.FEASIBLE, last)).schedule)

    options = LoopOptions(5.0, forecast="perfect")
    found = judge_operation(island, scenario, run_loop(island, scenario, ask, options).trajectory, "NO")
    mean_hz, relative_hz = island.bounds("NO").limit[[0, 1]] / (2 * np.pi)
    assert found.excess_mean_hz < SOFT_TOLERANCE * mean_hz  # no plan knows the scenario's end
    assert found.excess_relative_hz < SOFT_TOLERANCE * relative_hz
    assert best.objective < 1.001 * found.objective
    assert found.objective < 1.02 * best.objective
    assert found.agc_travel_pu > 0


@pytest.mark.usefixtures("inline")
def test_rows_are_the_same_to_the_last_bit(island, scenario, tmp_path):
    """With all numbers of islands; and without hindsight, which may come later."""
    settings = get_method("ed").canonical(Settings("every=1"))
    asked = make_operations(
        island, [scenario], ("ed", settings), ["TO"], LoopOptions(5.0), "0.2", plant="detailed"
    )
    files = [OnlineResults(tmp_path / name) for name in "ab"]
    first, again = (operate(island, asked, results, look_back=False)[0] for results in files)
    varying = {"method_s": None, "loop_s": None, "plant_s": None, "date": ""}
    assert dataclasses.replace(first, **varying) == dataclasses.replace(again, **varying)
    assert first.error == ""
    assert first.increase_percent is None
    assert first.plant == "detailed"
    excesses = (first.excess_mean_hz, first.excess_relative_hz, first.excess_end_hz)
    assert first.max_excess_hz == max(excesses) > 0
    assert first.mean_freq_max_hz == pytest.approx(0.01 + first.excess_mean_hz)
    assert first.swing_max_hz > first.swing_rms_hz > 0
    kept = read_arrays(files[0].files.trajectory(first.key))[0]
    assert np.abs(np.diff(kept["agc"])).sum() == pytest.approx(first.agc_travel_pu, rel=1e-12)


def test_the_commands_draw_and_operate_an_island(tmp_path, capsys):
    """A grid in a folder of its own; `every` is also the time between its plans."""
    out = tmp_path / "scenarios"
    assert main(["scenarios", "--case", str(MIXED), "--count", "1", "--out", str(out)]) == 0
    (file,) = scenario_files(out)
    words = ["online", "--case", str(MIXED), "--scenario", str(file), "--method", "ed", "--set", "every=60"]
    words += ["--latency", "zero", "--regime", "TO", "--no-hindsight", "--out", str(tmp_path / "results")]
    assert main(words) == 0
    (row,) = OnlineResults(tmp_path / "results").table.rows.values()
    assert (row.period_s, row.plans, row.error) == (60.0, 5, "")
    assert row.cps1 is not None
    assert "no hindsight" in capsys.readouterr().out


@pytest.mark.parametrize("name", AGC_CASES)
def test_shipped_scenarios_can_be_served(name):
    """Sums; at rest in balance; static dispatch serves; loads of an hour drift within 5 %."""
    folder, case = SHIPPED_CASES / name / "scenarios", Case.load(name)
    for file, digest in read_record(Manifest, folder / "MANIFEST.json").files.items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
    scenarios = load_scenarios(scenario_files(folder), case)
    assert [s.duration_s for s in scenarios] == [300.0] * 20 + [HOUR_S] * 5
    for scenario in (scenarios[0], scenarios[-1]):
        assert scenario.seed[0] >= 4_000_000
        assert not any(scenario.initial.omega.values())
        times = np.linspace(0.0, scenario.duration_s, 6)
        plant_of(case).static_dispatch(whole_instance(case, scenario), times)
        plant_of(case).initial(scenario.snapshot(case, 0.0))
    for load, nominal in zip(scenarios[-1].load.values(), case.load_nominal, strict=False):
        drift = np.abs(load.fluctuation.values / nominal)
        assert 0.005 < drift.max() <= DRIFT + 1e-6
        assert abs(load.at(np.array(3600.0)) / nominal - 1) <= HOUR_RANGE + DRIFT + 1e-6
