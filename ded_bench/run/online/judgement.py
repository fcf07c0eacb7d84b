"""What operating a scenario cost and which limits it broke, beside hindsight and loads that no plan knew.

Hindsight is the whole scenario optimised at once with true loads, for the case's own plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import Plant
from ded_bench.plants.score import STRICT_HZ, judge
from ded_bench.plants.simulate import simulate
from ded_bench.problem.case import Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.instance import Instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.trajectory import Trajectory
from ded_bench.run.online.loop import LoopOptions

#: Knots of hindsight lie so many times as close as the case's: renewed plans may bend anywhere.
FINER = 4


@dataclass(frozen=True)
class Judgement:
    """One trajectory in one regime; the excess at a point of time is the worst generator's."""

    objective: float  # Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all grid points, as of the scorer
    max_excess_hz: float  # max over k, i of (|ω_i| - bound)_+
    mean_excess_hz: float  # mean over k of max over i of (|ω_i| - bound)_+
    share_outside: float  # of the grid points where some |ω_i| is more than 1e-6 Hz beyond the bound
    ramp_violation: float  # pu per step
    bound_violation: float  # pu
    slack_travel_pu: float  # Σ_k |P_s(t_k+1) - P_s(t_k)|


@dataclass(frozen=True)
class Hindsight:
    """The optimum of one scenario and regime."""

    method: str
    judgement: Judgement
    trajectory: Trajectory


def judge_operation(case: Case, scenario: Scenario, trajectory: Trajectory, regime: str) -> Judgement:
    """Judge a trajectory over the whole scenario.

    Raises:
        InputError: unknown regime.
    """
    score = judge(case, scenario.snapshot(case, 0.0), trajectory, regime)
    excess = np.abs(trajectory.omega).max(axis=1) - case.omega_bound(regime)
    excess_hz = np.maximum(excess, 0.0) / (2 * np.pi)
    return Judgement(
        objective=score.objective,
        max_excess_hz=score.freq_violation_hz,
        mean_excess_hz=float(excess_hz.mean()),
        share_outside=float((excess_hz > STRICT_HZ).mean()),
        ramp_violation=score.ramp_violation,
        bound_violation=score.bound_violation,
        slack_travel_pu=float(np.abs(np.diff(trajectory.p_slack)).sum()),
    )


def hindsight(case: Case, scenario: Scenario, regime: str, plant: Plant | None = None) -> Hindsight:
    """Optimise the whole scenario by sequential linear programs, or by collocation where they fail.

    Args:
        case: the grid.
        scenario: with its true loads.
        regime: gives the bound of |ω|.
        plant: what is operated; None: the case's own.

    Raises:
        RuntimeError: neither finds a schedule.
        SimulationError: the plant cannot follow it.
    """
    instance = whole_instance(case, scenario)
    interval_s = case.sampling.horizon_s / (case.n_knots - 1) / FINER
    reasons = []
    for name, options in (("ded-slp", f"knot_s={interval_s!r}"), ("ded-radau", "")):
        solution = get_method(name).prepare(case, regime, Settings(options))(instance)
        if solution.schedule is not None:
            trajectory = simulate(case, instance, solution.schedule, plant)
            return Hindsight(name, judge_operation(case, scenario, trajectory, regime), trajectory)
        reasons.append(solution.error)
    raise RuntimeError(f"no schedule for the whole of {scenario.id}: {reasons[-1]}")


def whole_instance(case: Case, scenario: Scenario) -> Instance:
    """A scenario as one instance, with its true loads."""
    points = forecast(scenario, case, "perfect", 0.0, scenario.duration_s).points(0.0, scenario.duration_s)
    return Instance(
        schema_="ded-bench/instance/2",
        id=scenario.id,
        case=case.id,
        seed=scenario.seed,
        horizon_s=scenario.duration_s,
        dt_s=scenario.dt_s,
        cost=scenario.cost,
        load=dict(zip(case.loads, points, strict=True)),
        initial=scenario.initial,
    )


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
