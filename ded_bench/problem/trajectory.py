"""Trajectory: what one instance does under one schedule, at the points of its time grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.problem.case import Array, Case

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What one instance does under one schedule, at the grid points t_k."""

    t: Array  # (n,), s
    omega: Array  # (n, n_gen), rad/s, deviation from nominal
    p_set: Array  # (n, n_gen), pu: set-points
    p_gen: Array  # (n, n_gen), pu: delivered
    p_load: Array  # (n, n_load), pu
    p_slack: Array  # (n,), pu
    case: Case
    states: Any = None  # of the plant that made it, for its own use
    columns: Mapping[str, Array] = field(default_factory=dict)  # what only this plant has, by name

    def cost(self, cost_gen: Array, cost_slack: float) -> float:
        """Σ_k Σ_i c_i P_i(t_k) + c_s |P_s(t_k)| over all grid points (paper, objective)."""
        return float((self.p_gen @ cost_gen + cost_slack * np.abs(self.p_slack)).sum())

    def to_frame(self) -> pd.DataFrame:
        """One row per grid point, columns named by bus in the case's order.

        `t` (s); `P_<bus>` of the generators, delivered, then of the slack, if there is one (pu);
        `L_<bus>` of the loads (injections, pu); `omega_<bus>` of the generators (rad/s, deviation from
        nominal); then the plant's own, such as `theta_<bus>` (rad, relative to the slack).
        """
        import pandas as pd  # here only: the scorer does without it

        case = self.case
        columns = {"t": self.t}
        columns |= {f"P_{bus}": values for bus, values in zip(case.generators, self.p_gen.T, strict=True)}
        columns |= {} if case.slack is None else {f"P_{case.slack}": self.p_slack}
        columns |= {f"L_{bus}": values for bus, values in zip(case.loads, self.p_load.T, strict=True)}
        columns |= {f"omega_{bus}": values for bus, values in zip(case.generators, self.omega.T, strict=True)}
        return pd.DataFrame(columns | dict(self.columns))
