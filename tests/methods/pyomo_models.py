"""Programs of `ded-slp` and `ded-radau` written again in Pyomo, to check their arrays with other solvers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo
from numpy.typing import NDArray

from ded_bench.methods.ded import injections, power_limits
from ded_bench.methods.knots import power_limits as knot_limits
from ded_bench.methods.radau_program import BETWEEN, POINTS, WEIGHTS, lagrange
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance


def build_ded_slp(case: Case, instance: Instance, bound: float, model: TimeVarying) -> pyo.ConcreteModel:
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

    @m.Constraint(m.gen, m.step)
    def ineq_frequency(m: Any, g: int, k: int) -> Any:
        change = m.deviation[model.speed.start + g, k]
        return pyo.inequality(-bound, model.omega[k, g] + change, bound)

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


def build_ded_radau(case: Case, instance: Instance, regime: str, ends: NDArray[np.int_]) -> pyo.ConcreteModel:
    """`ded-radau` by Pyomo.DAE; time is scaled so that every element has length one: dx/dτ = h dx/dt."""
    network, elements, bound = Network(case), len(ends) - 1, case.omega_bound(regime)
    steps = dict(enumerate(np.diff(ends).tolist(), 1))
    length = {e: n * instance.dt_s for e, n in steps.items()}
    m = pyo.ConcreteModel()
    m.tau = dae.ContinuousSet(bounds=(0, elements))
    m.element, m.end = pyo.RangeSet(1, elements), pyo.RangeSet(0, elements)
    m.gen = pyo.Set(initialize=case.generators, ordered=True)
    m.algebraic = pyo.Set(initialize=[case.buses[i].id for i in network.algebraic], ordered=True)
    m.theta, m.omega = pyo.Var(m.gen, m.tau), pyo.Var(m.gen, m.tau, initialize=0.0)
    m.dtheta = dae.DerivativeVar(m.theta, wrt=m.tau, initialize=0.0)
    m.domega = dae.DerivativeVar(m.omega, wrt=m.tau, initialize=0.0)
    m.angle = pyo.Var(m.algebraic, m.tau)
    m.p_gen = pyo.Var(m.gen, m.end, bounds=power_limits(case))
    m.p_slack_up = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    m.p_slack_down = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    pyo.TransformationFactory("dae.collocation").apply_to(
        m, wrt=m.tau, nfe=elements, ncp=len(POINTS), scheme="LAGRANGE-RADAU"
    )
    points = dict(zip(list(m.tau)[1:], itertools.product(m.element, POINTS), strict=True))
    m.fractions = points

    # The state at t = 0 is fixed, and the initial point for the whole horizon.
    angles = network.initial_angles(instance).tolist()
    for buses, variable in ((network.generators, m.theta), (network.algebraic, m.angle)):
        for i in buses:
            variable[case.buses[i].id, :].set_value(angles[i])
    for g, power in zip(case.generators, instance.p_initial(case).tolist(), strict=True):
        m.p_gen[g, :].set_value(power, skip_validation=True)
        m.theta[g, 0].fix()
        m.omega[g, 0].fix(instance.initial.omega[g])
        m.p_gen[g, 0].fix()

    injection, load = injections(m, m.tau, case, network), instance.p_load(case)
    starts = np.append(0.0, np.cumsum(list(length.values())))
    at = {0.0: 0.0} | {tau: starts[e - 1] + c * length[e] for tau, (e, c) in points.items()}

    @m.Constraint(m.gen, points)
    def eq_swing(m: Any, g: str, tau: float) -> Any:
        (e, c), machine = points[tau], case.machines[g]
        power = (1 - c) * m.p_gen[g, e - 1] + c * m.p_gen[g, e]
        force = power - injection(g, tau) - machine.d * m.omega[g, tau]
        return machine.m * m.domega[g, tau] == length[e] * force

    @m.Constraint(m.gen, points)
    def eq_angle(m: Any, g: str, tau: float) -> Any:
        return m.dtheta[g, tau] == length[points[tau][0]] * m.omega[g, tau]

    @m.Constraint(m.algebraic, m.tau)
    def eq_load(m: Any, bus: str, tau: float) -> Any:
        if bus not in case.loads:
            return injection(bus, tau) == 0.0
        return injection(bus, tau) == float(np.interp(at[tau], instance.grid, load[:, case.loads.index(bus)]))

    @m.Constraint(m.tau)
    def eq_slack(m: Any, tau: float) -> Any:
        return m.p_slack_up[tau] - m.p_slack_down[tau] == injection(case.slack, tau)

    taus, ramp = list(m.tau), dict(zip(case.generators, case.ramp.tolist(), strict=True))

    @m.Constraint(m.gen, taus[1:])
    def ineq_omega(m: Any, g: str, tau: float) -> Any:
        return pyo.inequality(-bound, m.omega[g, tau], bound)

    @m.Constraint(m.gen, m.element, BETWEEN)
    def ineq_between(m: Any, g: str, e: int, c: float) -> Any:
        values = [m.omega[g, tau] for tau in taus[3 * (e - 1) : 3 * e + 1]]
        omega = sum(weight * value for weight, value in zip(lagrange(c), values, strict=True))
        return pyo.inequality(-bound, omega, bound)

    @m.Constraint(m.gen, m.element)
    def ineq_ramp(m: Any, g: str, e: int) -> Any:
        return pyo.inequality(-ramp[g], (m.p_gen[g, e] - m.p_gen[g, e - 1]) / length[e], ramp[g])

    cost, cost_slack, weight = (
        instance.cost,
        instance.cost_slack(case),
        dict(zip(POINTS, WEIGHTS, strict=True)),
    )

    def p_slack(tau: float) -> Any:
        return m.p_slack_up[tau] + m.p_slack_down[tau]

    def cost_rate(end: int) -> Any:
        return sum(cost[g] * m.p_gen[g, end] for g in m.gen) + cost_slack * p_slack(end)

    @m.Objective()
    def cost_total(m: Any) -> Any:
        """The sum over grid points: half of what is at an element's ends, and all between by quadrature."""
        means = ((steps[e] * cost[g] / 2, g, e) for g in m.gen for e in m.element)
        generation = sum(half * (m.p_gen[g, e - 1] + m.p_gen[g, e]) for half, g, e in means)
        slack = sum(weight[c] * steps[e] * cost_slack * p_slack(tau) for tau, (e, c) in points.items())
        return generation + slack + (cost_rate(0) + cost_rate(m.end.last())) / 2

    return m
