"""The scorer: what a schedule costs and which limits it breaks, simulated on a plant.

It sees an instance and a schedule, never a model, a network or a solver's status.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.plants.plant import Plant, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule, Trajectory

#: What counts as feasible: excess frequency in Hz, also on islands, and excess of power limits in pu.
FEASIBLE_HZ, ISLAND_HZ, FEASIBLE_PU = 1e-4, 1e-5, 1e-6
STRICT_HZ, STRICT_PU = 1e-6, 1e-8
#: The column of a plant's own in which secondary control is found: what it asks of all machines, pu.
AGC_COLUMN = "agc"


@dataclass(frozen=True)
class Score:
    """Cost and largest violations of one schedule in one regime (paper, Tables V and VI).

    Islands have numbers about the mean frequency, weighted with inertia, and swings about it, too.
    """

    objective: float  # cost Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all grid points, delivered powers
    freq_violation_hz: float  # largest excess over any bound on frequencies
    ramp_violation: float  # max of (|P(t_k+1) - P(t_k)| - ε)_+, pu per step
    bound_violation: float  # max excess over limits of generators and transfers, pu
    initial_violation: float  # max |P(t_0) - P_0|, pu
    mean_freq_rms_hz: float | None = None
    mean_freq_max_hz: float | None = None
    swing_rms_hz: float | None = None  # over all machines and points
    swing_max_hz: float | None = None
    excess_mean_hz: float | None = None
    excess_relative_hz: float | None = None
    excess_end_hz: float | None = None
    agc_travel_pu: float | None = None  # Σ_k |ΔP_agc(t_k)|

    @property
    def feasible(self) -> bool:
        """Every limit is met within 1e-4 Hz, on an island 1e-5 Hz, and 1e-6 pu."""
        return self._within(FEASIBLE_HZ if self.excess_mean_hz is None else ISLAND_HZ, FEASIBLE_PU)

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
    p_set, excess = trajectory.p_set, case.bounds(regime).excess_hz(trajectory.omega)
    excess_ramp = np.abs(np.diff(p_set, axis=0)) - case.ramp * instance.dt_s
    excess_bound = np.maximum(p_set - case.p_max, case.p_min - p_set)
    excess_transfer = case.transfer_excess(p_set, trajectory.p_load)
    own = _island_numbers(trajectory, excess) if "mean" in excess else {}
    return Score(
        objective=trajectory.cost(instance.cost_gen(case), instance.cost_slack(case)),
        freq_violation_hz=max(excess.values()),
        ramp_violation=float(max(excess_ramp.max(), 0.0)),
        bound_violation=float(max(excess_bound.max(), excess_transfer.max(initial=0.0), 0.0)),
        initial_violation=float(np.abs(p_set[0] - instance.p_initial(case)).max()),
        **own,
    )


def _island_numbers(trajectory: Trajectory, excess: dict[str, float]) -> dict[str, float]:
    hz, mean = trajectory.omega / (2 * np.pi), mean_hz(trajectory)
    found = {f"excess_{kind}_hz": value for kind, value in excess.items()}
    for name, values in (("mean_freq", mean), ("swing", hz - mean[:, None])):
        found[f"{name}_rms_hz"] = float(np.sqrt(np.mean(values**2)))
        found[f"{name}_max_hz"] = float(np.abs(values).max())
    agc = trajectory.columns.get(AGC_COLUMN, np.zeros(1))
    return found | {"agc_travel_pu": float(np.abs(np.diff(agc)).sum())}


def mean_hz(trajectory: Trajectory) -> Array:
    """The mean frequency, weighted with inertia, (n,), Hz, deviation from nominal."""
    weight = trajectory.case.inertia
    return np.asarray(trajectory.omega / (2 * np.pi) @ (weight / weight.sum()))
