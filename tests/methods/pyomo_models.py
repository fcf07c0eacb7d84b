"""The program of `ded-slp` written again in Pyomo, to check its arrays with another solver."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyomo.environ as pyo

from ded_bench.methods.knots import power_limits as knot_limits
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds


def build_ded_slp(case: Case, instance: Instance, bounds: Bounds, model: TimeVarying) -> pyo.ConcreteModel:
    """One program of `ded-slp` with a state, a limit and |P_s| at every grid point: what arrays reduce."""
    n_gen, n_state, steps = len(case.generators), model.slack.shape[1], len(model.omega) - 1
    interval = np.searchsorted(model.points, np.arange(steps + 1), side="right") - 1
    interval = np.minimum(interval, len(model.lengths) - 1)
    part = (np.arange(steps + 1) - model.points[interval]) / model.lengths[interval]
    m = pyo.ConcreteModel()
    m.knot, m.point, m.step = (
        pyo.RangeSet(0, len(model.lengths)),
        pyo.RangeSet(0, steps),
        pyo.RangeSet(1, steps),
    )
    m.gen, m.state = pyo.RangeSet(0, n_gen - 1), pyo.RangeSet(0, n_state - 1)
    p_min, p_max = knot_limits(case, instance, model.lengths)
    p_initial = instance.p_initial(case)

    def range_of(m: Any, g: int, j: int) -> tuple[float, float]:
        return (p_initial[g], p_initial[g]) if j == 0 else (p_min[j - 1, g], p_max[j - 1, g])

    m.p_set = pyo.Var(m.gen, m.knot, bounds=range_of)
    m.deviation = pyo.Var(m.state, m.point)
    m.p_slack_up = pyo.Var(m.point, bounds=(0, None))
    m.p_slack_down = pyo.Var(m.point, bounds=(0, None))

    @m.Expression(m.gen, m.point)
    def increment(m: Any, g: int, k: int) -> Any:
        j = int(interval[k])
        ends = ((1 - part[k], j), (part[k], j + 1))
        return sum(weight * (m.p_set[g, e] - model.p_gen[e, g]) for weight, e in ends)

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
        change = pyo.quicksum(model.slack[interval[k], s] * m.deviation[s, k] for s in m.state)
        return m.p_slack_up[k] - m.p_slack_down[k] == model.p_slack[k] + change

    @m.Constraint(range(len(bounds.limit)), m.step)
    def ineq_frequency(m: Any, o: int, k: int) -> Any:
        if bounds.at_end[o] and k < steps:
            return pyo.Constraint.Skip
        omega = [model.omega[k, g] + m.deviation[model.speed.start + g, k] for g in m.gen]
        output = pyo.quicksum(weight * one for weight, one in zip(bounds.matrix[o], omega, strict=True))
        return pyo.inequality(-bounds.limit[o], output, bounds.limit[o])

    @m.Constraint(m.gen, m.knot)
    def ineq_ramp(m: Any, g: int, j: int) -> Any:
        if j == 0:
            return pyo.Constraint.Skip
        limit = case.ramp[g] * model.lengths[j - 1] * instance.dt_s
        return pyo.inequality(-limit, m.p_set[g, j] - m.p_set[g, j - 1], limit)

    def delivered(g: int, k: int) -> Any:
        j = int(interval[k])
        if model.delivered is None:
            along = (1 - part[k]) * model.p_gen[j, g] + part[k] * model.p_gen[j + 1, g]
            return along + m.increment[g, k]
        on_state = pyo.quicksum(model.delivered.c[j, g, s] * m.deviation[s, k] for s in m.state)
        on_input = pyo.quicksum(model.delivered.d[j, g, n] * m.increment[n, k] for n in m.gen)
        return model.delivered.p_gen[k, g] + on_state + on_input

    cost, price = instance.cost_gen(case), instance.cost_slack(case)

    @m.Objective()
    def cost_total(m: Any) -> Any:
        generation = pyo.quicksum(cost[g] * delivered(g, k) for g in m.gen for k in m.point)
        return generation + price * pyo.quicksum(m.p_slack_up[k] + m.p_slack_down[k] for k in m.point)

    return m
