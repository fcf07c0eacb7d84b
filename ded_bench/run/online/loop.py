"""The loop: measure, forecast, predict, plan, and follow the plan while the next one is made.

A decision at τ leads to a plan from τ + latency on. Until then the plant follows the last plan, so that the
state at τ + latency can be predicted: the loads of that prediction are forecast, the plant is the true one.
Times are whole steps of the scenario's grid; a latency is rounded up to them. Every plan is asked of a
process of its own, which is killed if it takes too long.
"""

from __future__ import annotations

import atexit
import math
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ded_bench.methods.knots import track
from ded_bench.methods.plugin import accept
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import Piece, Plant, PlantState, SimulationError, plant_of
from ded_bench.plants.score import AGC_COLUMN
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row, interpolated
from ded_bench.problem.forecast import Forecast, forecast
from ded_bench.problem.instance import Instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.schedule import Schedule, Trajectory
from ded_bench.run.pool import Children, NoAnswerError, WorkerDiedError, read
from ded_bench.run.runner import GRACE_S
from ded_bench.run.tasks import prepared, reason_of, trace_of
from ded_bench.solvers.status import Status

#: The process that plans.
_children = Children()
atexit.register(_children.close)
#: How long a method may take for one plan unless told otherwise, s of the clock.
LIMIT_S = 60.0


@dataclass(frozen=True)
class Planned:
    """A method's answer to one instance: a schedule, or why there is none."""

    schedule: Schedule | None
    late: bool = False  # it did not come in time
    warm: bool = False  # the method was given the plan in force
    infeasible: bool = False  # no schedule meets every limit, says the method; this one, if any, comes near
    error: str = ""
    trace: str = ""  # of what it raised


#: Asks for a plan; given the last one, on the instance's time, unless it has a `starts_warm` that is false.
Ask = Callable[[Instance, Schedule | None], Planned]


@dataclass
class Planner:
    """Asks one method for plans. A method that raises or dies gives none; one that hangs is late."""

    case: Case
    regime: str
    method: str
    settings: Settings
    limit_s: float = LIMIT_S
    starts_warm: bool = True  # whether the method knows how to start from a plan, once it is prepared
    _ready: bool = False

    def __call__(self, instance: Instance, last: Schedule | None = None) -> Planned:
        """Ask for a plan; the process prepares the method first, if it has not done so yet."""
        job = self.case, self.method, self.regime, self.settings
        if not self._ready:
            prepared = _call(_prepare, job, self.limit_s + GRACE_S)
            if not isinstance(prepared, bool):
                return self._none(prepared)
            self._ready, self.starts_warm = True, prepared
        answer = _call(answered, (*job, instance, last), self.limit_s)
        if not isinstance(answer, tuple):
            return self._none(answer)
        solution, warm = answer
        return Planned(solution.schedule, False, warm, solution.status == Status.INFEASIBLE, solution.error)

    def _none(self, error: object) -> Planned:
        self._ready = self._ready and not isinstance(error, NoAnswerError | WorkerDiedError)
        return Planned(None, isinstance(error, NoAnswerError), error=reason_of(error), trace=trace_of(error))


def _call(function: Callable[..., object], arguments: tuple[object, ...], limit_s: float) -> object:
    """What a function answers in the other process, or the exception that came instead."""
    return read(_children.call(pickle.dumps((function, arguments)), limit_s))


def _prepare(case: Case, method: str, regime: str, settings: Settings) -> bool:
    return hasattr(prepared(case, method, regime, settings), "solve")


def answered(
    case: Case, method: str, regime: str, settings: Settings, instance: Instance, last: Schedule | None
) -> tuple[Solution, bool]:
    """Solve in this process as in operation, if the method knows how; tells if it was given the last plan."""
    started = time.perf_counter()
    solver = prepared(case, method, regime, settings)
    operate = getattr(solver, "solve", None)
    start = None if last is None else Solution(Status.FEASIBLE, last)
    answer = solver(instance) if operate is None else operate(instance, last=start)
    warm = operate is not None and start is not None
    return accept(answer, case, instance, time.perf_counter() - started), warm


#: Between plans unless told otherwise, s.
PERIOD_S = 1.0
#: Steps that differ from a whole number by less are whole.
WHOLE = 1e-6


@dataclass(frozen=True)
class LoopOptions:
    """How a loop runs."""

    period_s: float = PERIOD_S
    latency_s: float = 0.0
    forecast: str = "announced"
    predict: bool = True  # plan from the state predicted for τ + latency; False: from that at τ
    warm: bool = True  # methods that can use the plan in force are given it
    horizon_s: float = 0.0  # plans last at least so long; no less than the period and the case's horizon
    to_end: bool = False  # but not beyond the scenario

    def steps(self, dt_s: float) -> tuple[int, int]:
        """Period and latency in steps of the grid."""
        return max(round(self.period_s / dt_s), 1), math.ceil(self.latency_s / dt_s - WHOLE)


class LoopOutcome(NamedTuple):
    """What happened, and every answer, in their order."""

    trajectory: Trajectory
    answers: list[Planned]
    plans_s: float  # from measurements to answers, all together, s of the clock
    plant_s: float  # while the plant went on, likewise


@compiled
def _later(t: Array, p: Array, passed: float, horizon_s: float) -> tuple[Array, Array]:
    """Times and powers of a schedule from a time on, for `horizon_s`; its end stays."""
    times, count = np.empty(len(t) + 2), 1
    times[0] = 0.0
    for later in t - passed:
        if WHOLE < later < horizon_s - WHOLE:
            times[count] = later
            count += 1
    times[count] = horizon_s
    times = times[: count + 1]
    return times, interpolated(t, p, times + passed)


@compiled
def _followed(t: Array, p: Array, times: Array, first: Array, limits: tuple[Array, Array, Array]) -> Array:
    """Powers at some times on the way from the `first` ones to a schedule's, within limits (see `track`)."""
    power = interpolated(t, p, times)
    copy_row(first, power[0])
    track(power.reshape((1, *power.shape)), *limits)
    return power


class History:
    """What a plant has done since t = 0, and where it is; grows piece by piece.

    Args:
        case: the grid.
        plant: what is operated.
        first: how it begins.
        grid: all times, (n,), s.
        p_load: load injections at them, (n, n_load), pu.

    Raises:
        SimulationError: the plant cannot begin so.
    """

    def __init__(self, case: Case, plant: Plant, first: Instance, grid: Array, p_load: Array) -> None:
        self._case, self._plant, self._grid, self._dt = case, plant, grid, first.dt_s
        self.now, self.state, self.p_load = 0, plant.initial(first), p_load
        self.omega, self.p_set, self.p_gen = np.empty((3, len(grid), len(case.generators)))
        self.p_slack, self.agc = np.empty((2, len(grid)))
        self.p_set[0] = first.p_initial(case)
        self.plant_s = 0.0  # what the plant took to go on, s of the clock

    def go_on(self, p_set: Array) -> None:
        """Go on under set-points at the present point and those after it, shape (n, n_gen), pu."""
        k = slice(self.now, self.now + len(p_set))
        started = time.perf_counter()
        piece = self.ahead(p_set, self.p_load[k])
        self.plant_s += time.perf_counter() - started
        self.omega[k], self.p_set[k], self.p_gen[k] = piece.omega, p_set, piece.p_gen
        self.p_slack[k], self.agc[k], self.state = piece.p_slack, piece.agc, piece.end
        self.now += len(p_set) - 1

    def ahead(self, p_set: Array, p_load: Array) -> Piece:
        """What set-points and loads from now on would lead to; raises as `Plant.advance`."""
        return self._plant.advance(self.state, p_set, p_load, self._dt)

    def trajectory(self) -> Trajectory:
        """All of it, without the plant's own states; of its columns, what secondary control asks for."""
        columns = {} if self._case.agc is None else {AGC_COLUMN: self.agc}
        whole = (self._grid, self.omega, self.p_set, self.p_gen, self.p_load, self.p_slack, self._case)
        return Trajectory(*whole, columns=columns)


def run_loop(
    case: Case, scenario: Scenario, ask: Ask, options: LoopOptions, plant: Plant | None = None
) -> LoopOutcome:
    """Operate one scenario with plans of one method.

    The first plan is made for the true initial state and is there at t = 0; decisions follow every period,
    or as soon as the last plan is due, if that is later. Where there is none, the last plan goes on; before
    the first one, powers stay.

    Args:
        case: the grid.
        scenario: what happens.
        ask: for plans.
        options: how the loop runs.
        plant: what is operated; None: the case's own.

    Raises:
        SimulationError: the plant cannot follow.
    """
    return _Loop(case, scenario, ask, options, plant or plant_of(case)).run()


class _Loop:
    def __init__(self, case: Case, scenario: Scenario, ask: Ask, options: LoopOptions, plant: Plant) -> None:
        self.case, self.scenario, self.ask, self.options, self.plant = case, scenario, ask, options, plant
        self.dt = scenario.dt_s
        self.horizon, longest = case.sampling.horizon_s, max(options.period_s, options.horizon_s)
        if longest > self.horizon:
            self.horizon = math.ceil(longest / self.dt - WHOLE) * self.dt
        first, p_load = scenario.snapshot(case, 0.0), scenario.p_load(case)
        self.history = History(case, plant, first, scenario.grid, p_load)
        power = self.history.p_set[0]
        # The plan in force, where on the scenario's grid it begins, and whether a method has made it.
        self.plan, self.start, self.held = (np.array([0.0, self.horizon]), np.array([power, power])), 0, False
        endless = np.full_like(case.ramp, np.inf)
        self.limits = -endless, endless, case.ramp * self.dt
        self.asked, self.plans_s = list[Planned](), 0.0

    def run(self) -> LoopOutcome:
        last = self.scenario.steps
        period, lag = self.options.steps(self.dt)
        self._take(self._decide(0), 0)
        decision = period
        while decision + lag < last:
            self._go_on(decision)
            due = decision + lag
            answer = self._decide(lag)
            self._go_on(due)
            self._take(answer, due if self.options.predict else decision)
            decision = max(decision + period, due)
        self._go_on(last)
        return LoopOutcome(self.history.trajectory(), self.asked, self.plans_s, self.history.plant_s)

    def _decide(self, lag: int) -> Planned:
        """Ask for a plan from `lag` steps after now, or from now on."""
        measured, now = time.perf_counter(), self.history.now
        start = now + lag if self.options.predict else now
        until = (now + lag) * self.dt + self.horizon
        loads = forecast(self.scenario, self.case, self.options.forecast, now * self.dt, until)
        try:
            instance = self._instance(self._state(loads, start), loads, start)
        except SimulationError as error:
            answer = Planned(None, error=f"no prediction: {error}")
        else:
            warm = self.options.warm and self.held and getattr(self.ask, "starts_warm", True)
            passed = self.scenario.grid[start - self.start]
            last = Schedule(*_later(*self.plan, passed, self.horizon)) if warm else None
            answer = self.ask(instance, last)
        self.plans_s += time.perf_counter() - measured
        self.asked.append(answer)
        return answer

    def _take(self, answer: Planned, start: int) -> None:
        if answer.schedule is not None:
            plan = answer.schedule.t, np.ascontiguousarray(answer.schedule.p)
            self.plan, self.start, self.held = plan, start, True

    def _state(self, loads: Forecast, start: int) -> PlantState:
        """The state that a plan from `start` begins with."""
        if start == self.history.now:
            return self.history.state
        times = self.scenario.grid[self.history.now : start + 1]
        return self.history.ahead(self._followed(start), loads.at(times)).end

    def _instance(self, state: PlantState, loads: Forecast, start: int) -> Instance:
        left = (self.scenario.steps - start) * self.dt
        horizon = min(self.horizon, left) if self.options.to_end else self.horizon
        name, initial = f"{self.scenario.id[:50]}-{start}", self.plant.observed(state).initial(self.case)
        return loads.instance(start * self.dt, horizon, initial, name)

    def _go_on(self, until: int) -> None:
        if until > self.history.now:
            self.history.go_on(self._followed(until))

    def _followed(self, until: int) -> Array:
        """Set-points from now to `until` on the way to the plan's, within ramp limits."""
        now = self.history.now
        times = self.scenario.grid[now - self.start : until + 1 - self.start]
        return _followed(*self.plan, times, self.history.p_set[now], self.limits)
