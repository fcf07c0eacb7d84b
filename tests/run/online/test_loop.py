"""The loop does what its plans say, predicts rightly, compensates latency, survives faults, and is judged."""

from __future__ import annotations

import time

import numpy as np
import pytest

from ded_bench.methods import ded_slp
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import plant_of, servable, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.scenario import Fluctuation, Scenario, ScenarioRamp
from ded_bench.problem.schedule import Schedule
from ded_bench.run.online import loop
from ded_bench.run.online.judgement import hindsight, judge_operation, unforeseen_hz, whole_instance
from ded_bench.run.online.loop import LoopOptions, Planned, Planner, run_loop
from ded_bench.solvers.status import Status
from tests.conftest import CASE_FILES

REGIME = "TO"


@pytest.fixture(scope="module", params=["threebus", "fivemachine"])
def small(request) -> Case:
    """Each of the small cases."""
    return Case.load(CASE_FILES[request.param])


class Asked:
    """A method in this process that keeps what it was asked and what it answered."""

    def __init__(self, case: Case) -> None:
        self.solver = ded_slp.prepare(case, REGIME, Settings())
        self.instances: list[Instance] = []
        self.last: list[Schedule | None] = []
        self.schedules: list[Schedule] = []

    def __call__(self, instance: Instance, last: Schedule | None) -> Planned:
        start = None if last is None else Solution(Status.FEASIBLE, last)
        schedule = self.solver.solve(instance, start).schedule
        self.instances.append(instance)
        self.last.append(last)
        if schedule is not None:  # else no plan keeps the bound any more
            self.schedules.append(schedule)
        return Planned(schedule, warm=last is not None)


def drawn(case: Case, horizons: int = 2):
    """A scenario of some horizons of a small case."""
    return sample_scenario(case, 0, 3, servable, horizons * case.sampling.horizon_s)


def test_perfect_knowledge_without_latency_is_the_open_loop(small):
    """Two plans, one after the other, do what the simulation of both in one schedule does."""
    scenario, asked = drawn(small), Asked(small)
    horizon = small.sampling.horizon_s
    outcome = run_loop(small, scenario, asked, LoopOptions(period_s=horizon, forecast="perfect"))
    first, second = asked.schedules
    whole = Schedule(np.concatenate([first.t, horizon + second.t[1:]]), np.vstack([first.p, second.p[1:]]))
    wanted = simulate(small, whole_instance(small, scenario), whole)
    np.testing.assert_allclose(outcome.trajectory.omega, wanted.omega, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outcome.trajectory.p_gen, wanted.p_gen, rtol=0, atol=1e-12)
    np.testing.assert_allclose(outcome.trajectory.p_slack, wanted.p_slack, rtol=0, atol=1e-9)
    assert [answer.schedule is None for answer in outcome.answers] == [False, False]
    assert [answer.warm for answer in outcome.answers] == [False, True]


def test_a_plan_takes_from_the_measurement_to_the_answer(small, monkeypatch):
    """The forecast is a part of it."""
    known = loop.forecast
    monkeypatch.setattr(loop, "forecast", lambda *given: time.sleep(0.02) or known(*given))
    outcome = run_loop(small, drawn(small), lambda *_: Planned(None), LoopOptions(period_s=1.0))
    assert outcome.plans_s > 0.02 * len(outcome.answers)


@pytest.mark.parametrize(("quality", "tolerance"), [("perfect", 1e-9), ("announced", 1e-2)])
def test_plans_start_from_the_state_when_they_take_effect(small, quality, tolerance):
    """Exactly, where loads are known; powers are known in any case."""
    scenario, asked = drawn(small), Asked(small)
    options = LoopOptions(period_s=0.5, latency_s=0.736, forecast=quality)
    trajectory = run_loop(small, scenario, asked, options).trajectory
    starts = [round(int(i.id.rsplit("-", 1)[1])) for i in asked.instances]
    assert starts[:3] == [0, 50 + 74, 50 + 74 + 74]  # latencies are rounded up to steps
    again = simulate(small, whole_instance(small, scenario), Schedule(trajectory.t, trajectory.p_set))
    angles = np.stack([again.columns[f"theta_{bus}"] for bus in small.generators], axis=1)
    wrong = []
    for k, instance in zip(starts, asked.instances, strict=True):
        np.testing.assert_allclose(instance.p_initial(small), trajectory.p_set[k], rtol=0, atol=1e-12)
        wrong.append(np.abs(instance.omega_initial(small) - trajectory.omega[k]).max())
        wrong.append(np.abs(instance.theta_initial(small) - angles[k]).max())
    assert max(wrong) < tolerance
    assert (max(wrong) > 1e-9) == (quality != "perfect")


def test_the_present_state_is_the_measured_one(small):
    """Plans then start when they are asked for, and are followed from where they are due."""
    scenario, asked = drawn(small), Asked(small)
    options = LoopOptions(period_s=1.0, latency_s=0.5, predict=False)
    trajectory = run_loop(small, scenario, asked, options).trajectory
    starts = [int(i.id.rsplit("-", 1)[1]) for i in asked.instances]
    assert starts[:3] == [0, 100, 200]
    for k, instance in zip(starts, asked.instances, strict=True):
        np.testing.assert_allclose(instance.omega_initial(small), trajectory.omega[k], rtol=0, atol=1e-15)


def test_the_last_plan_is_handed_on_in_the_time_of_the_next(small):
    """Shifted by the period; its end stays; none for the first, and none where it is not wanted."""
    scenario, asked = drawn(small), Asked(small)
    run_loop(small, scenario, asked, LoopOptions(period_s=1.0))
    assert asked.last[0] is None
    later = asked.last[1]
    times = np.linspace(0.0, small.sampling.horizon_s, 101)
    later.check(small.sampling.horizon_s)
    np.testing.assert_allclose(later.at(times), asked.schedules[0].at(times + 1.0), atol=1e-12)
    cold = Asked(small)
    run_loop(small, scenario, cold, LoopOptions(period_s=1.0, warm=False))
    assert cold.last == [None] * len(cold.instances)


def test_prediction_buys_back_latency():
    """Planning from the present state at 1 s exceeds the bound by more than from the predicted one."""
    case = Case.load(CASE_FILES["fivemachine"])
    scenario = drawn(case, 3)
    known = LoopOptions(period_s=0.5, forecast="perfect")
    choices = {
        "instant": known,
        "predicted": LoopOptions(0.5, 1.0, "perfect"),
        "present": LoopOptions(0.5, 1.0, "perfect", predict=False),
    }
    _, best, _ = hindsight(case, scenario, REGIME)
    assert best.max_excess_hz < 1e-6
    found = {
        name: judge_operation(case, scenario, run_loop(case, scenario, Asked(case), o).trajectory, REGIME)
        for name, o in choices.items()
    }
    assert found["instant"].max_excess_hz < 2e-6
    assert found["predicted"].max_excess_hz < 2e-6
    assert found["present"].max_excess_hz > 3 * max(found["predicted"].max_excess_hz, 1e-6)
    assert best.objective < found["instant"].objective < 1.002 * best.objective


@pytest.mark.parametrize(
    ("name", "late", "failed"), [("raises", 0, 2), ("nonsense", 0, 2), ("sleeps", 2, 0), ("never", 0, 6)]
)
def test_a_faulty_method_is_counted_and_the_loop_goes_on(threebus, name, late, failed):
    """Plans at 2 s and 5 s do not come; without any plan, powers stay."""
    scenario = drawn(threebus, 1)
    planner = Planner(threebus, REGIME, f"tests.run.online.faulty_methods:{name}", Settings(), limit_s=2.0)
    outcome = run_loop(threebus, scenario, planner, LoopOptions())
    missing = [answer for answer in outcome.answers if answer.schedule is None]
    assert len(outcome.answers) == 6
    assert sum(answer.late for answer in missing) == late
    assert len(missing) == late + failed
    assert missing[0].error
    assert np.isfinite(outcome.trajectory.omega).all()
    moved = np.abs(np.diff(outcome.trajectory.p_gen, axis=0)).max()
    assert (moved == 0) == (name == "never")
    assert not planner.starts_warm  # functions do not: none is given a plan


@pytest.mark.parametrize("warm", [True, False])
def test_plans_that_meet_not_every_limit_are_followed_and_counted(threebus, warm):
    """By a method of others, which is given the plan in force if that is wanted."""
    planner = Planner(threebus, REGIME, "tests.run.online.faulty_methods:strained", Settings())
    outcome = run_loop(threebus, drawn(threebus, 1), planner, LoopOptions(warm=warm))
    assert all(answer.schedule is not None for answer in outcome.answers)
    assert sum(answer.infeasible for answer in outcome.answers) == 2
    assert any(answer.warm for answer in outcome.answers) == warm
    assert planner.starts_warm


def test_another_plant_is_operated_and_plans_are_for_the_own_one(threebus, lagged):
    """Delivered powers lag behind set-points; plans go on from set-points, and the cost is of what came."""
    scenario, asked = drawn(threebus, 1), Asked(threebus)
    plant = plant_of(threebus, "lagged")
    found = run_loop(threebus, scenario, asked, LoopOptions(latency_s=0.3), plant).trajectory
    assert 1e-3 < np.abs(found.p_gen - found.p_set).max() < 0.1
    for instance in asked.instances:
        k = int(instance.id.rsplit("-", 1)[1])
        np.testing.assert_allclose(instance.p_initial(threebus), found.p_set[k], rtol=0, atol=1e-12)
    schedule = Schedule(found.t, found.p_set)
    wanted = simulate(threebus, whole_instance(threebus, scenario), schedule, plant)
    np.testing.assert_allclose(found.omega, wanted.omega, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.p_gen, wanted.p_gen, rtol=0, atol=1e-12)
    judgement = judge_operation(threebus, scenario, found, REGIME)
    instance = whole_instance(threebus, scenario)
    assert judgement.objective == found.cost(instance.cost_gen(threebus), instance.cost_slack(threebus))


def test_the_judgement_of_a_known_trajectory(threebus):
    """Half of the time beyond the bound by a known excess; slack travel by hand."""
    scenario = drawn(threebus, 1)
    trajectory = run_loop(threebus, scenario, lambda *_: Planned(None), LoopOptions()).trajectory
    bound, n = threebus.omega_bound(REGIME), len(trajectory.t)
    trajectory.omega[:] = 0.0
    trajectory.omega[: n // 2] = -(bound + 2 * np.pi * 0.001)
    trajectory.p_slack[:] = 0.25
    trajectory.p_slack[5] = -0.25
    found = judge_operation(threebus, scenario, trajectory, REGIME)
    assert found.max_excess_hz == pytest.approx(0.001)
    assert found.share_outside == (n // 2) / n
    assert found.mean_excess_hz == pytest.approx(0.001 * (n // 2) / n)
    assert found.slack_travel_pu == 1.0
    cost = trajectory.p_gen[0] @ [scenario.cost[g] for g in threebus.generators]
    assert found.objective == pytest.approx(n * (cost + 0.25 * scenario.cost[threebus.slack]))


def surprising(case: Case, rate: float) -> Scenario:
    """Nothing happens but one ramp that nobody announced."""
    scenario = sample_scenario(case, 0, 3, servable, 20.0)
    load = {}
    for number, (bus, one) in enumerate(scenario.load.items()):
        ramp = ScenarioRamp(start=4.45, duration=10.0, rate=rate, announced_start=None, announced_rate=None)
        still = Fluctuation(step_s=1.0, values=(0.0, 0.0), decay_s=20.0)
        load[bus] = one.model_copy(update={"ramps": (ramp,) if number == 0 else (), "fluctuation": still})
    return scenario.model_copy(update={"load": load})


def stay(instance, last):
    """Powers stay as they are."""
    power = np.array(list(instance.initial.power.values()))
    return Planned(Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power])))


@pytest.mark.parametrize("options", [LoopOptions(), LoopOptions(period_s=0.7, latency_s=1.2)])
def test_it_is_what_happens_when_powers_stay(case: Case, options: LoopOptions) -> None:
    """From the one ramp to the plan that knows of it: the difference it makes."""
    scenario = surprising(case, -1e-2)
    found = unforeseen_hz(case, scenario, options, plant_of(case))
    with_ramp, without = (
        run_loop(case, one, stay, options).trajectory.omega for one in (scenario, surprising(case, 0.0))
    )
    moved = np.abs(with_ramp - without) / (2 * np.pi)
    decisions = np.arange(0.0, 20.0, max(options.period_s, options.latency_s))
    known = decisions[decisions > 4.45][0] + options.latency_s
    reached = moved[: round(known / scenario.dt_s) + 1].max()
    # The grid is nearly linear: it matters little that one swings a little at t = 0 and the other rests.
    assert found == pytest.approx(reached, rel=1e-2)
    assert found > 0


def test_what_is_foreseen_moves_nothing_and_what_comes_late_moves_more(case: Case) -> None:
    scenario = surprising(case, -1e-3)
    plant = plant_of(case)
    foreseen = unforeseen_hz(case, scenario, LoopOptions(forecast="perfect"), plant)
    assert foreseen == pytest.approx(0.0, abs=1e-12)
    moved = [unforeseen_hz(case, scenario, LoopOptions(period_s=s), plant) for s in (0.1, 1.0, 2.0)]
    assert 0 < moved[0] < moved[1] < moved[2]
    twice = unforeseen_hz(case, surprising(case, -2e-3), LoopOptions(period_s=1.0), plant)
    assert twice == pytest.approx(2 * moved[1], rel=1e-3)  # nearly linear
