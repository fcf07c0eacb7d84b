"""What operating a scenario cost and which limits it broke, beside hindsight and loads that no plan knew.

Hindsight is the whole scenario optimised at once with true loads, for the case's own plant; on islands in
windows that overlap, where it is long.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import Plant, simulate
from ded_bench.plants.score import STRICT_HZ, judge, mean_hz
from ded_bench.problem.case import Array, Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.instance import Instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.schedule import Schedule, Trajectory
from ded_bench.results.online_results import Judgement
from ded_bench.results.rows import OfIslands
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from ded_bench.solvers.status import Status

#: Knots of hindsight lie so many times as close as the case's: renewed plans may bend anywhere.
FINER = 4
#: Length of a window of an island's hindsight, s.
WINDOW_S = 300.0
#: The Eastern Interconnection's bound on the rms of minutes' mean frequency, Hz (NERC BAL-001, CPS1).
EPSILON_HZ, MINUTE_S = 0.018, 60.0


def judge_operation(case: Case, scenario: Scenario, trajectory: Trajectory, regime: str) -> Judgement:
    """Judge a trajectory over the whole scenario.

    Raises:
        InputError: unknown regime.
    """
    score = judge(case, scenario.snapshot(case, 0.0), trajectory, regime)
    bounds = case.bounds(regime)
    excess = bounds.beyond(trajectory.omega @ bounds.matrix.T).max(axis=1)
    excess_hz = np.maximum(excess, 0.0) / (2 * np.pi)
    return Judgement(
        objective=score.objective,
        max_excess_hz=score.freq_violation_hz,
        mean_excess_hz=float(excess_hz.mean()),
        share_outside=float((excess_hz > STRICT_HZ).mean()),
        ramp_violation=score.ramp_violation,
        bound_violation=score.bound_violation,
        slack_travel_pu=float(np.abs(np.diff(trajectory.p_slack)).sum()),
        **{f.name: getattr(score, f.name) for f in fields(OfIslands)},
        cps1=cps1(trajectory.t, mean_hz(trajectory)) if case.slack is None else None,
    )


def cps1(t: Array, mean: Array) -> float:
    """Control performance: 100 (2 - mean over minutes of (mean frequency of the minute)² / ε²), %.

    As NERC's CPS1 of an island, which has no tie: its area control error is -10 B Δf. What is left at the end
    counts as a minute if it is half of one or more, or all that there is, else with the one before.

    Args:
        t: from 0, equidistant, (n,), s.
        mean: frequency deviation, (n,), Hz.
    """
    steps = max(round(MINUTE_S / (t[1] - t[0])), 1)
    starts = np.arange(max(int((len(t) - 1) / steps + 0.5), 1)) * steps
    minutes = np.add.reduceat(mean, starts) / np.diff(starts, append=len(mean))
    return float(100 * (2 - np.mean(minutes**2) / EPSILON_HZ**2))


def hindsight(
    case: Case, scenario: Scenario, regime: str, plant: Plant | None = None
) -> tuple[str, Judgement, Trajectory]:
    """Optimise the whole scenario by sequential linear programs, or by collocation without their optimum.

    Args:
        case: the grid.
        scenario: with its true loads.
        regime: gives the bound of |ω|.
        plant: what is operated; None: the case's own.

    Returns:
        The method that found it, what it costs, and the trajectory.

    Raises:
        RuntimeError: neither finds a schedule.
        SimulationError: the plant cannot follow it.
    """
    if case.slack is None:
        return _in_windows(case, scenario, regime)
    instance = whole_instance(case, scenario)
    interval_s = case.sampling.horizon_s / (case.n_knots - 1) / FINER
    found: dict[str, Schedule] = {}  # the last is the best
    for name, options in (("ded-slp", f"knot_s={interval_s!r}"), ("ded-radau", "")):
        solution = get_method(name).prepare(case, regime, Settings(options))(instance)
        if solution.schedule is not None:
            found[name] = solution.schedule
        if solution.status == Status.OPTIMAL:
            break
    if not found:
        raise RuntimeError(f"no schedule for the whole of {scenario.id}: {solution.error}")
    name, schedule = list(found.items())[-1]
    trajectory = simulate(case, instance, schedule, plant)
    return name, judge_operation(case, scenario, trajectory, regime), trajectory


def _in_windows(case: Case, scenario: Scenario, regime: str) -> tuple[str, Judgement, Trajectory]:
    """Optimise windows of WINDOW_S, the next one from the middle of each on, with the case's knots."""
    interval_s = case.sampling.horizon_s / (case.n_knots - 1)
    solver = get_method("ded-slp").prepare(case, regime, Settings(f"knot_s={interval_s!r}"))

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        solution = solver(instance)
        if solution.schedule is None:
            raise RuntimeError(f"no schedule for {instance.id}: {solution.error}")
        return Planned(solution.schedule)

    period_s = scenario.duration_s if scenario.duration_s <= WINDOW_S else WINDOW_S / 2
    options = LoopOptions(period_s, forecast="perfect", horizon_s=WINDOW_S, to_end=True)
    trajectory = run_loop(case, scenario, ask, options).trajectory
    return "ded-slp", judge_operation(case, scenario, trajectory, regime), trajectory


def whole_instance(case: Case, scenario: Scenario) -> Instance:
    """A scenario as one instance, with its true loads."""
    last, loads = scenario.duration_s, forecast(scenario, case, "perfect", 0.0, scenario.duration_s)
    return loads.instance(0.0, last, scenario.initial, scenario.id)


def unforeseen_hz(case: Case, scenario: Scenario, options: LoopOptions, plant: Plant) -> float:
    """Largest move of any frequency by loads unknown to the plan in force, whatever the plans are.

    What begins after a measurement is in no plan before the next one is in force, one period and one latency
    later. Until then it moves frequencies; as far as the plant is linear, by as much under every plan. So the
    plant is left in its state of t = 0, but for the difference between loads and their forecast. A plan can
    have room for it on one side only, twice the bound at most: what moves frequencies farther leads to an
    excess under every plan.

    Args:
        case: the grid.
        scenario: what happens.
        options: period, latency and forecast.
        plant: what is operated.

    Raises:
        SimulationError: the plant cannot carry such loads.
    """
    first, dt, loads = scenario.snapshot(case, 0.0), scenario.dt_s, scenario.p_load(case)
    period, lag = options.steps(dt)
    period = max(period, lag)
    state, power = plant.initial(first), np.tile(first.p_initial(case), (period + lag + 1, 1))
    rest = plant.advance(state, power, np.tile(loads[0], (len(power), 1)), dt).omega
    largest = 0.0
    for now in range(0, scenario.steps, period):
        end = min(now + period + lag, scenario.steps)
        times = np.arange(now, end + 1, dtype=np.float64) * dt
        expected = forecast(scenario, case, options.forecast, times[0], times[-1])
        unknown = loads[now : end + 1] - expected.at(times)
        if np.abs(unknown).max() == 0:
            continue
        moved = plant.advance(state, power[: len(times)], loads[0] + unknown, dt).omega
        largest = max(largest, float(np.abs(moved - rest[: len(times)]).max()))
    return largest / (2 * np.pi)
