"""Swing equations with identified electrical powers, integrated by an explicit Runge-Kutta method."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled
from ded_bench.truth.integrator import Inputs, Tableau


class Polynomial(NamedTuple):
    """Electrical powers of machines, the slack's last: a polynomial in x = (θ, P_load), centred and scaled.

    Monomials are products of two: `parent`, an earlier one, and variable `factor`; the first one is 1.
    """

    centre: Array  # (n_x,)
    scale: Array  # (n_x,)
    parent: NDArray[np.int_]  # (n_monomial,)
    factor: NDArray[np.int_]  # (n_monomial,)
    weight: Array  # (n_monomial, n_machine), pu
    shape: Array  # (n_x, n_x): the data lie where |shape z| ≤ reach, z the scaled variables
    reach: float


@compiled
def integrate_swing(
    tableau: Tableau,
    law: Polynomial,
    machines: Array,
    inputs: Inputs,
    steps: int,
    theta: Array,
    omega: Array,
    p_slack: Array,
) -> int:
    """Integrate from the first point of time to the last.

    Args:
        tableau: the method.
        law: electrical powers.
        machines: inertia and damping of the generators, (2, n_gen).
        inputs: powers of generators and loads at n points of time.
        steps: steps from one point to the next.
        theta: angles of the generators, (n, n_gen), rad; the first row is given, others are computed.
        omega: frequency deviations, (n, n_gen), rad/s; likewise.
        p_slack: receives the slack's power, (n,), pu.

    Returns:
        The number of points computed: less than n where a state lies beyond the data of the polynomial.
    """
    n: int = len(omega)
    n_gen, n_stages = omega.shape[1], len(tableau.c)
    h = inputs.dt / steps
    z, p = np.empty(len(law.centre)), np.empty(law.weight.shape[1])
    monomial = np.ones(len(law.parent))
    angle_rate, speed_rate = np.empty((n_stages, n_gen)), np.empty((n_stages, n_gen))
    start, speed, angle = theta[0].copy(), omega[0].copy(), np.empty(n_gen)
    for k in range(n):
        after = min(k + 1, n - 1)
        for j in range(steps):
            for s in range(n_stages):
                inside = (j + tableau.c[s]) / steps
                for g in range(n_gen):
                    angle[g], angle_rate[s, g] = start[g], speed[g]
                    for r in range(s):
                        angle[g] += h * tableau.a[s, r] * angle_rate[r, g]
                        angle_rate[s, g] += h * tableau.a[s, r] * speed_rate[r, g]
                    z[g] = (angle[g] - law.centre[g]) / law.scale[g]
                for i in range(n_gen, len(z)):
                    load = inputs.injection[k, i - n_gen]
                    load += inside * (inputs.injection[after, i - n_gen] - load)
                    z[i] = (load - law.centre[i]) / law.scale[i]
                for i in range(1, len(monomial)):
                    monomial[i] = monomial[law.parent[i]] * z[law.factor[i]]
                p[:] = 0.0
                for i in range(len(monomial)):
                    for g in range(len(p)):
                        p[g] += monomial[i] * law.weight[i, g]
                if s == 0 and j == 0:
                    if not _distance(law, z) <= law.reach:
                        return k
                    theta[k], omega[k], p_slack[k] = angle, speed, p[n_gen]
                    if k == n - 1:
                        return n
                for g in range(n_gen):
                    wanted = inputs.p_gen[k, g] + inside * (inputs.p_gen[after, g] - inputs.p_gen[k, g])
                    rate = wanted - p[g] - machines[1, g] * angle_rate[s, g]
                    speed_rate[s, g] = rate / machines[0, g]
            for s in range(n_stages):
                for g in range(n_gen):
                    start[g] += h * tableau.b[s] * angle_rate[s, g]
                    speed[g] += h * tableau.b[s] * speed_rate[s, g]
    return n


@compiled
def _distance(law: Polynomial, z: Array) -> float:
    """How far a state is from the middle of the data."""
    total = 0.0
    for i in range(len(z)):
        row = 0.0
        for j in range(len(z)):
            row += law.shape[i, j] * z[j]
        total += row * row
    return float(np.sqrt(total))
