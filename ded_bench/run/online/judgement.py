"""What a scenario's operation cost and which limits it broke, from its true trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.plants.score import STRICT_HZ, judge
from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.trajectory import Trajectory


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
