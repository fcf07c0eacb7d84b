"""The scorer: what a schedule costs and which limits it breaks, simulated on a plant.

It sees an instance and a schedule, never a model, a network or a solver's status.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.plants.plant import Plant
from ded_bench.plants.simulate import simulate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.trajectory import Trajectory

#: What counts as feasible: excess frequency in Hz, excess of power limits in pu.
FEASIBLE_HZ, FEASIBLE_PU = 1e-4, 1e-6
STRICT_HZ, STRICT_PU = 1e-6, 1e-8


@dataclass(frozen=True)
class Score:
    """Cost and largest violations of one schedule in one regime (paper, Tables V and VI)."""

    objective: float  # Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all grid points
    freq_violation_hz: float  # max over k, i of (|ω_i| - bound)_+
    ramp_violation: float  # max of (|P(t_k+1) - P(t_k)| - ε)_+, pu per step
    bound_violation: float  # max excess over the generator limits, pu
    initial_violation: float  # max |P(t_0) - P_0|, pu

    @property
    def feasible(self) -> bool:
        """Every limit is met within 1e-4 Hz and 1e-6 pu."""
        return self._within(FEASIBLE_HZ, FEASIBLE_PU)

    @property
    def feasible_strict(self) -> bool:
        """Every limit is met within 1e-6 Hz and 1e-8 pu."""
        return self._within(STRICT_HZ, STRICT_PU)

    def _within(self, hz: float, pu: float) -> bool:
        power = (self.ramp_violation, self.bound_violation, self.initial_violation)
        return self.freq_violation_hz <= hz and all(excess <= pu for excess in power)


def score(
    case: Case, instance: Instance, schedule: Schedule, regime: str, plant: Plant | None = None
) -> Score:
    """Simulate one schedule on a plant, the case's own unless another is given, and judge it.

    Raises:
        InputError: unknown regime, or the schedule does not span the horizon.
        SimulationError: the plant cannot follow this schedule.
    """
    case.check_regimes([regime])
    return judge(case, instance, simulate(case, instance, schedule, plant), regime)


def judge(case: Case, instance: Instance, trajectory: Trajectory, regime: str) -> Score:
    """Cost of what was delivered, and violations: ramps and limits are of the set-points."""
    p_set = trajectory.p_set
    excess_omega = np.abs(trajectory.omega) - case.omega_bound(regime)
    excess_ramp = np.abs(np.diff(p_set, axis=0)) - case.ramp * instance.dt_s
    excess_bound = np.maximum(p_set - case.p_max, case.p_min - p_set)
    return Score(
        objective=trajectory.cost(instance.cost_gen(case), instance.cost_slack(case)),
        freq_violation_hz=_positive(excess_omega.max()) / (2 * np.pi),
        ramp_violation=_positive(excess_ramp.max()),
        bound_violation=_positive(excess_bound.max()),
        initial_violation=float(np.abs(p_set[0] - instance.p_initial(case)).max()),
    )


def _positive(value: float) -> float:
    return max(float(value), 0.0)
