"""Operation of `ded-rti` beside a slack: when ramps may begin, room for them, plans when there is news."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surprises import Surprises, _delayed
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.scenario import Scenario, ScenarioRamp
from ded_bench.problem.schedule import Schedule
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from ded_bench.solvers.status import Status


@pytest.fixture(scope="module")
def two_area() -> Case:
    return Case.load("two-area")


def test_room_is_asked_for_before_ramps_that_nobody_announces_and_seldom_else(two_area: Case) -> None:
    """By the law of scenarios: one ramp in every stretch, and one in five not announced."""
    case, asked, before = two_area, [], []
    for index in range(3):
        scenario = sample_scenario(case, 4_300_000, index)
        surprises, due = Surprises(case, case.omega_bound("TO")), []

        def ask(instance: Instance, last: Schedule | None, known=surprises, due=due) -> Planned:
            known.expected(instance, last)
            power = instance.p_initial(case)
            stay = Schedule(np.array([0.0, 30.0, instance.horizon_s]), np.array([power] * 3))
            known.keep(stay, instance)
            due.append({load for _, load, _, is_sudden in known._at(0, 0.0) if not is_sudden})
            return Planned(stay)

        run_loop(case, scenario, ask, LoopOptions(period_s=1.0))
        asked += [len(loads) for loads in due]
        for load, bus in enumerate(case.loads):
            starts = [r.start for r in scenario.load[bus].ramps if r.announced_start is None]
            before += [load in due[int(start)] for start in starts if start < scenario.duration_s - 1.0]
    assert len(before) >= 4
    assert np.mean(before) > 0.8  # a ramp may begin in the next stretch, since the one before goes on
    assert np.mean(asked) / len(case.loads) < 0.2  # a tenth, says the law


def test_time_goes_on_while_plans_fail(two_area: Case) -> None:
    """Stretches are counted from the start of operation; what no plan was made for stays news."""
    scenario = sample_scenario(two_area, 4_300_000, 0)
    surprises, clock = Surprises(two_area, two_area.omega_bound("TO")), []

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        expected, power = surprises.expected(instance, last), instance.p_initial(two_area)
        clock.append((surprises.now_s, surprises.is_news(expected)))
        given = Schedule(np.array([0.0, 30.0, instance.horizon_s]), np.array([power] * 3))
        plan = None if 3 <= len(clock) <= 5 else given
        surprises.keep(plan, instance)
        return Planned(plan)

    run_loop(two_area, scenario.model_copy(update={"duration_s": 8.0}), ask, LoopOptions(period_s=1.0))
    assert [now for now, _ in clock] == pytest.approx(np.arange(8.0))
    assert all(is_news for _, is_news in clock)


def test_a_load_that_waits_goes_on_as_it_would_have() -> None:
    load = LoadPoints(points=((0.0, -1.0), (2.0, -1.0), (4.0, -2.0), (10.0, -2.0)))
    later, t = _delayed(load, 2.0, 0.5, 10.0), np.linspace(0.0, 9.0, 91)
    assert later.at(t) == pytest.approx(np.where(t < 2.0, load.at(t), load.at(np.maximum(t - 0.5, 2.0))))


def steep(case: Case) -> Scenario:
    """A load that falls faster than generators at their limits can follow, and nobody says when."""
    scenario = sample_scenario(case, 4_300_000, 0)
    ramp = ScenarioRamp(start=20.0, duration=15.0, rate=0.14, announced_start=None, announced_rate=None)
    load = {
        bus: one.model_copy(update={"ramps": (ramp,) if bus == "7" else ()})
        for bus, one in scenario.load.items()
    }
    initial = scenario.initial.model_copy(
        update={
            "power": dict(zip(case.generators, case.p_min.tolist(), strict=True)),
            "omega": dict.fromkeys(case.generators, 0.0),
        }
    )
    cost = dict.fromkeys(case.generators, 0.5) | {case.slack: 0.2}
    return scenario.model_copy(update={"duration_s": 25.0, "load": load, "initial": initial, "cost": cost})


def operated(case: Case, period_s: float, options: str) -> tuple[float, int]:
    """Largest excess over the bound, mHz, and how many plans were made."""
    solver, made = get_method("ded-rti").prepare(case, "TO", Settings(options=options)), []

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        solution = solver.solve(instance, None if last is None else Solution(Status.FEASIBLE, last))
        made.append(solution.iterations is not None)
        return Planned(solution.schedule)

    omega = run_loop(case, steep(case), ask, LoopOptions(period_s)).trajectory.omega
    return 1e3 * (np.abs(omega).max() - case.omega_bound("TO")) / (2 * np.pi), sum(made)


def test_a_steep_ramp_that_nobody_announced_is_followed(two_area: Case) -> None:
    """Without room it exceeds the bound; plans are made every second, and for news."""
    excess, plans = operated(two_area, 0.1, "default")
    assert excess < 0
    assert 25 <= plans < 50
    without, _ = operated(two_area, 0.5, "reserve=off")
    assert without > 0.5
