"""State: where the grid's generators are at one instant."""

from __future__ import annotations

from dataclasses import dataclass

from ded_bench.problem.case import Array


@dataclass(frozen=True, eq=False)
class State:
    """Angles, frequency deviations and powers of the generators; load angles follow from the loads.

    It need not be an equilibrium.
    """

    theta: Array  # (n_gen,), rad, relative to the slack
    omega: Array  # (n_gen,), rad/s, deviation from nominal
    p_gen: Array  # (n_gen,), pu
