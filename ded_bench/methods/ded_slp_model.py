"""One program of `ded-slp` as a Pyomo model, with every grid point in it: what `knot_program` reduces.

It is for reading, and for checking the reduction with another solver; `ded-slp` itself does not use it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyomo.environ as pyo

from ded_bench.koopman.trajectory import TrajectoryModel
from ded_bench.methods.knots import power_limits
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance


def build_ded_slp(case: Case, instance: Instance, bound: float, model: TrajectoryModel) -> pyo.ConcreteModel:
    """Return the unsolved linear program around a trajectory that starts at P_0.

    Args:
        case: the grid.
        instance: costs and P_0.
        bound: limit of |ω|, rad/s.
        model: the linear model along the trajectory.
    """
    n_gen, steps = len(case.generators), len(model.omega) - 1
    interval = (
        np.minimum(np.searchsorted(model.points, np.arange(steps + 1), side="right"), len(model.lengths)) - 1
    )
    part = (np.arange(steps + 1) - model.points[interval]) / model.lengths[interval]
    m = pyo.ConcreteModel()
    m.knot = pyo.RangeSet(0, len(model.lengths))
    m.point = pyo.RangeSet(0, steps)
    m.step = pyo.RangeSet(1, steps)
    m.gen = pyo.RangeSet(0, n_gen - 1)
    m.state = pyo.RangeSet(0, 2 * n_gen - 1)

    # Variables: generator power at the knots, pu; deviations (δθ, δω) from the trajectory, rad and rad/s.
    p_min, p_max = power_limits(case, instance, model.lengths)
    p_initial = instance.p_initial(case)

    def range_of(m: Any, g: int, j: int) -> tuple[float, float]:
        return (p_initial[g], p_initial[g]) if j == 0 else (p_min[j - 1, g], p_max[j - 1, g])

    m.p_gen = pyo.Var(m.gen, m.knot, bounds=range_of)
    m.deviation = pyo.Var(m.state, m.point)
    m.p_slack_up = pyo.Var(m.point, bounds=(0, None))
    m.p_slack_down = pyo.Var(m.point, bounds=(0, None))

    # Constraints.
    @m.Expression(m.gen, m.point)
    def power(m: Any, g: int, k: int) -> Any:
        j = int(interval[k])
        return (1 - part[k]) * m.p_gen[g, j] + part[k] * m.p_gen[g, j + 1]

    @m.Expression(m.gen, m.point)
    def increment(m: Any, g: int, k: int) -> Any:
        j = int(interval[k])
        return m.power[g, k] - (1 - part[k]) * model.p_gen[j, g] - part[k] * model.p_gen[j + 1, g]

    @m.Constraint(m.state)
    def eq_initial(m: Any, i: int) -> Any:
        return m.deviation[i, 0] == 0

    @m.Constraint(m.state, m.step)
    def eq_dynamics(m: Any, i: int, k: int) -> Any:
        f, g, h = (array[interval[k - 1], i] for array in model.step)
        terms = [f[s] * m.deviation[s, k - 1] for s in m.state]
        for n in m.gen:
            terms += [(g[n] - h[n]) * m.increment[n, k - 1], h[n] * m.increment[n, k]]
        return m.deviation[i, k] == pyo.quicksum(terms)

    @m.Constraint(m.point)
    def eq_slack(m: Any, k: int) -> Any:
        change = pyo.quicksum(model.slack[interval[k], g] * m.deviation[g, k] for g in m.gen)
        return m.p_slack_up[k] - m.p_slack_down[k] == model.p_slack[k] + change

    @m.Constraint(m.gen, m.step)
    def ineq_frequency(m: Any, g: int, k: int) -> Any:
        return pyo.inequality(-bound, model.omega[k, g] + m.deviation[n_gen + g, k], bound)

    @m.Constraint(m.gen, m.knot)
    def ineq_ramp(m: Any, g: int, j: int) -> Any:
        if j == 0:
            return pyo.Constraint.Skip
        limit = case.ramp[g] * model.lengths[j - 1] * instance.dt_s
        return pyo.inequality(-limit, m.p_gen[g, j] - m.p_gen[g, j - 1], limit)

    cost, price = instance.cost_gen(case), instance.cost_slack(case)

    @m.Objective()
    def cost_total(m: Any) -> Any:
        generation = pyo.quicksum(cost[g] * m.power[g, k] for g in m.gen for k in m.point)
        return generation + price * pyo.quicksum(m.p_slack_up[k] + m.p_slack_down[k] for k in m.point)

    return m
