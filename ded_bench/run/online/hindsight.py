"""Hindsight: the whole scenario optimised at once with true loads, to compare what plans cost with."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from ded_bench.methods import ded_radau
from ded_bench.methods.ded_slp import SlpSolver
from ded_bench.methods.ded_slp_ac import AcDynamics
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.trust_region import TrustRegionSequence
from ded_bench.plants.simulate import simulate
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.forecast import forecast
from ded_bench.problem.instance import Instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.trajectory import Trajectory
from ded_bench.run.online.judgement import Judgement, judge_operation
from ded_bench.truth.ac_simulate import simulate_ac

#: Knots lie so many times as close as the case's: plans that are renewed again and again may bend anywhere.
FINER = 4


@dataclass(frozen=True)
class Hindsight:
    """The optimum of one scenario and regime."""

    method: str
    judgement: Judgement
    trajectory: Trajectory


def hindsight(case: Case, scenario: Scenario, regime: str, data: AcCase | None = None) -> Hindsight:
    """Optimise the whole scenario by sequential linear programs, or by collocation where they fail.

    Args:
        case: the grid.
        scenario: with its true loads.
        regime: gives the bound of |ω|.
        data: optimise on the full AC network, where there is no collocation.

    Raises:
        RuntimeError: neither finds a schedule.
        SimulationError: the system cannot follow it.
    """
    instance = whole_instance(case, scenario)
    interval_s = case.sampling.horizon_s / (case.n_knots - 1) / FINER
    if data is not None:
        return _on_ac(case, scenario, regime, data)
    solution: Solution = SlpSolver(case, regime, knot_interval_s=interval_s)(instance)
    method = "ded-slp"
    if solution.schedule is None:
        solution, method = ded_radau.prepare(case, regime, Settings())(instance), "ded-radau"
    if solution.schedule is None:
        raise RuntimeError(f"no schedule for the whole of {scenario.id}: {solution.error}")
    trajectory = simulate(case, instance, solution.schedule)
    return Hindsight(method, judge_operation(case, scenario, trajectory, regime), trajectory)


def _on_ac(case: Case, scenario: Scenario, regime: str, data: AcCase) -> Hindsight:
    """On the case's knots: the sequence takes many more programs there."""
    instance = whole_instance(case, scenario)
    interval_s = case.sampling.horizon_s / (case.n_knots - 1)
    sequence = functools.partial(TrustRegionSequence, dynamics=AcDynamics(case, data))
    solution = SlpSolver(case, regime, knot_interval_s=interval_s, sequence=sequence)(instance)
    if solution.schedule is None:
        raise RuntimeError(f"no schedule for the whole of {scenario.id}: {solution.error}")
    trajectory = simulate_ac(case, data, instance, solution.schedule)
    return Hindsight("ded-slp ac", judge_operation(case, scenario, trajectory, regime), trajectory)


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
