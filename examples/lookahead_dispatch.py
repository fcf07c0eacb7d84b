"""One's own method in a dozen lines: economic dispatch with foresight of loads and ramps, blind to dynamics.

Run it from the folder that holds this file, or with that folder on PYTHONPATH:

    ded-bench solve --method lookahead_dispatch:solve --regime TO --limit 3 --out results/mine
    ded-bench report --results results/mine
"""

import pyomo.environ as pyo

from ded_bench import Schedule


def solve(instance, regime, case):
    """Minimise Σ c_i P_i + c_s |P_s| at the knots within bounds and ramps; P_s balances the loads."""
    t = case.knot_times(instance.horizon_s)
    load, start, step = instance.p_load(case, t).sum(axis=1), instance.p_initial(case), case.ramp * t[1]
    m = pyo.ConcreteModel()
    m.k, m.g = pyo.RangeSet(0, len(t) - 1), pyo.RangeSet(0, len(start) - 1)
    m.p = pyo.Var(m.k, m.g, bounds=lambda m, k, g: (case.p_min[g], case.p_max[g]))
    m.p_slack = pyo.Var(m.k, within=pyo.NonNegativeReals)  # |P_s|
    m.above = pyo.Constraint(m.k, rule=lambda m, k: m.p_slack[k] >= -load[k] - pyo.quicksum(m.p[k, :]))
    m.below = pyo.Constraint(m.k, rule=lambda m, k: m.p_slack[k] >= load[k] + pyo.quicksum(m.p[k, :]))
    ramps = [(k, g) for k in m.k if k for g in m.g]
    m.ramp = pyo.Constraint(
        ramps, rule=lambda m, k, g: pyo.inequality(-step[g], m.p[k, g] - m.p[k - 1, g], step[g])
    )
    for g in m.g:
        m.p[0, g].fix(start[g])
    cost = pyo.quicksum(float(c) * m.p[k, g] for k in m.k for g, c in enumerate(instance.cost_gen(case)))
    m.cost = pyo.Objective(expr=cost + instance.cost_slack(case) * pyo.quicksum(m.p_slack[:]))
    pyo.SolverFactory("appsi_highs").solve(m)
    return Schedule(t, [[pyo.value(m.p[k, g]) for g in m.g] for k in m.k])
