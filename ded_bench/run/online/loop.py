"""The loop: measure, forecast, predict, plan, and follow the plan while the next one is made.

A decision at τ leads to a plan from τ + latency on. Until then the grid follows the last plan, so that
the state at τ + latency can be predicted; the loads of that prediction are forecast, the grid is the
true one. Times are whole steps of the scenario's grid; a latency is rounded up to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.forecast import Forecast, forecast
from ded_bench.problem.instance import Initial, Instance, State
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.trajectory import Trajectory
from ded_bench.run.online.planner import Ask, Plan
from ded_bench.run.online.record import Grid, Plant, Record

#: Steps that differ from a whole number by less are whole.
WHOLE = 1e-6


@dataclass(frozen=True)
class LoopOptions:
    """How a loop runs."""

    period_s: float = 1.0
    latency_s: float = 0.0
    forecast: str = "announced"
    predict: bool = True  # plan from the state predicted for τ + latency; False: from that at τ
    warm: bool = True  # methods that can use the plan in force are given it


@dataclass(frozen=True)
class Outcome:
    """What happened, and how the plans came."""

    trajectory: Trajectory
    plans: int  # asked for
    late: int  # did not come in time
    failed: int  # came without a schedule that can be followed
    infeasible: int  # came with one, though by their method none meets every limit
    warm: bool  # the method was given the plan in force, at least once
    method_s: float  # the methods' own time, s of the clock
    error: str  # the first failure


@dataclass(frozen=True)
class _Course:
    """A schedule that is followed from a point of the scenario's grid on."""

    schedule: Schedule
    start: int
    dt: float

    def at(self, first: int, last: int) -> Array:
        """Planned powers at the points first..last, shape (last - first + 1, n_gen), pu; its end stays."""
        return self.schedule.at((np.arange(first, last + 1, dtype=np.float64) - self.start) * self.dt)

    def later(self, start: int, horizon_s: float) -> Schedule:
        """The same plan on the time of an instance that starts later and lasts `horizon_s`."""
        shifted = self.schedule.t - (start - self.start) * self.dt
        inside = shifted[(shifted > WHOLE) & (shifted < horizon_s - WHOLE)]
        times = np.concatenate([[0.0], inside, [horizon_s]])
        return Schedule(times, self.schedule.at(times + (start - self.start) * self.dt))


def run_loop(
    case: Case, scenario: Scenario, ask: Ask, options: LoopOptions, plant: Grid | None = None
) -> Outcome:
    """Operate one scenario with plans of one method.

    The first plan is made for the true initial state and is there at t = 0; decisions follow every period,
    or as soon as the last plan is due, if that is later. Where there is none, the last plan goes on; before
    the first one, powers stay.

    Args:
        case: the grid.
        scenario: what happens.
        ask: for plans.
        options: how the loop runs.
        plant: what is operated; without it, the lossless network.

    Raises:
        SimulationError: the system loses synchronism.
    """
    return _Loop(case, scenario, ask, options, plant or Plant(case, scenario)).run()


class _Loop:
    def __init__(self, case: Case, scenario: Scenario, ask: Ask, options: LoopOptions, plant: Grid) -> None:
        self.case, self.scenario, self.ask, self.options = case, scenario, ask, options
        self.dt, self.horizon = scenario.dt_s, case.sampling.horizon_s
        self.lag = math.ceil(options.latency_s / self.dt - WHOLE)
        self.period = max(round(options.period_s / self.dt), 1)
        self.record = Record(case, scenario, plant)
        power = self.record.p_gen[0]
        stay = Schedule(np.array([0.0, self.horizon]), np.array([power, power]))
        self.course, self.held = _Course(stay, 0, self.dt), False
        self.plans: list[Plan] = []

    def run(self) -> Outcome:
        last = self.scenario.steps
        self._take(self._decide(0), 0)
        decision = self.period
        while decision + self.lag < last:
            self._go_on(decision)
            due = decision + self.lag
            plan = self._decide(self.lag)
            self._go_on(due)
            self._take(plan, due if self.options.predict else decision)
            decision = max(decision + self.period, due)
        self._go_on(last)
        return self._outcome()

    def _decide(self, lag: int) -> Plan:
        """Ask for a plan from `lag` steps after now, or from now on."""
        now = self.record.now
        loads = self._forecast(now, now + lag)
        start = now + lag if self.options.predict else now
        try:
            instance = self._instance(self._state(loads, start), loads, start)
        except SimulationError as error:
            plan = Plan(None, error=f"no prediction: {error}")
        else:
            warm = self.options.warm and self.held
            plan = self.ask(instance, self.course.later(start, self.horizon) if warm else None)
        self.plans.append(plan)
        return plan

    def _take(self, plan: Plan, start: int) -> None:
        if plan.schedule is not None:
            self.course, self.held = _Course(plan.schedule, start, self.dt), True

    def _forecast(self, now: int, start: int) -> Forecast:
        until = start * self.dt + self.horizon
        return forecast(self.scenario, self.case, self.options.forecast, now * self.dt, until)

    def _state(self, loads: Forecast, start: int) -> State:
        """The state that a plan from `start` begins with."""
        if start == self.record.now:
            return self.record.state()
        times = np.arange(self.record.now, start + 1, dtype=np.float64) * self.dt
        return self.record.predicted(self._followed(start), loads.at(times))

    def _instance(self, state: State, loads: Forecast, start: int) -> Instance:
        points = loads.points(start * self.dt, self.horizon)
        values = ((state.p_gen, "power"), (state.omega, "omega"), (state.theta, "theta"))
        initial = {
            name: dict(zip(self.case.generators, array.tolist(), strict=True)) for array, name in values
        }
        return Instance(
            schema_="ded-bench/instance/2",
            id=f"{self.scenario.id[:50]}-{start}",
            case=self.case.id,
            seed=self.scenario.seed,
            horizon_s=self.horizon,
            dt_s=self.dt,
            cost=self.scenario.cost,
            load=dict(zip(self.case.loads, points, strict=True)),
            initial=Initial(**initial),
        )

    def _go_on(self, until: int) -> None:
        if until > self.record.now:
            self.record.advance(self._followed(until))

    def _followed(self, until: int) -> Array:
        """Powers from now to `until` on the way to the plan's, within ramp limits."""
        wanted = self.course.at(self.record.now, until)
        return follow(wanted, self.record.p_gen[self.record.now], self.case.ramp * self.dt)

    def _outcome(self) -> Outcome:
        missing = [plan for plan in self.plans if plan.schedule is None]
        return Outcome(
            trajectory=self.record.trajectory(),
            plans=len(self.plans),
            late=sum(plan.late for plan in missing),
            failed=sum(not plan.late for plan in missing),
            infeasible=sum(plan.infeasible and plan.schedule is not None for plan in self.plans),
            warm=any(plan.warm for plan in self.plans),
            method_s=sum(plan.seconds for plan in self.plans),
            error=missing[0].error if missing else "",
        )


def follow(wanted: Array, power: Array, step: Array) -> Array:
    """Powers that start at `power` and change by at most `step` from point to point towards the wanted ones.

    Args:
        wanted: shape (n, n_gen), pu; its first row is that of `power`.
        power: shape (n_gen,), pu.
        step: shape (n_gen,), pu.
    """
    followed = wanted.copy()
    followed[0] = power
    if not (np.abs(np.diff(followed, axis=0)) > step).any():
        return followed
    for k in range(1, len(followed)):
        followed[k] = followed[k - 1] + np.clip(wanted[k] - followed[k - 1], -step, step)
    return followed
