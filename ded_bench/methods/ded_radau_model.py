"""Full DED by collocation as a Pyomo model, discretised by Pyomo.DAE: the program of `radau_program`.

It is for reading, and for checking those arrays with another program; `ded-radau` itself does not use it.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo
from numpy.typing import NDArray

from ded_bench.methods.collocation import BETWEEN, POINTS, WEIGHTS, lagrange
from ded_bench.methods.ded import injections, power_limits
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.truth.network import Network


def build_ded_radau(case: Case, instance: Instance, regime: str, ends: NDArray[np.int_]) -> pyo.ConcreteModel:
    """Return the unsolved DED of the paper's eq. (DED_OG), discretised by collocation.

    Time is scaled so that every element has length one: dx/dτ = h dx/dt.

    Args:
        case: the grid.
        instance: costs, loads, the state at t = 0.
        regime: whose frequency bound; it holds at the collocation points and `BETWEEN` them.
        ends: grid indices of the element ends, shape (elements + 1,).
    """
    network, elements, bound = Network(case), len(ends) - 1, case.omega_bound(regime)
    steps = dict(enumerate(np.diff(ends).tolist(), 1))
    m = pyo.ConcreteModel()
    m.tau = dae.ContinuousSet(bounds=(0, elements))
    m.element = pyo.RangeSet(1, elements)
    m.end = pyo.RangeSet(0, elements)
    m.gen = pyo.Set(initialize=case.generators, ordered=True)
    m.algebraic = pyo.Set(initialize=[case.buses[i].id for i in network.algebraic], ordered=True)

    # Variables; angles in rad, frequencies in rad/s, powers in pu.
    m.theta = pyo.Var(m.gen, m.tau)
    m.omega = pyo.Var(m.gen, m.tau)
    m.dtheta = dae.DerivativeVar(m.theta, wrt=m.tau, initialize=0.0)
    m.domega = dae.DerivativeVar(m.omega, wrt=m.tau, initialize=0.0)
    m.angle = pyo.Var(m.algebraic, m.tau)
    m.p_gen = pyo.Var(m.gen, m.end, bounds=power_limits(case))
    m.p_slack_up = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    m.p_slack_down = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    pyo.TransformationFactory("dae.collocation").apply_to(
        m, wrt=m.tau, nfe=elements, ncp=len(POINTS), scheme="LAGRANGE-RADAU"
    )
    _start(m, case, instance)

    # Constraints and objective.
    _add_dynamics(m, case, instance, {e: n * instance.dt_s for e, n in steps.items()})
    _add_limits(m, case, bound, {e: n * instance.dt_s for e, n in steps.items()})
    _add_objective(m, instance, case, steps)
    return m


def collocation_points(m: pyo.ConcreteModel) -> dict[float, tuple[int, float]]:
    """The points of a discretised model, in order: τ as its index says, the element, the fraction in it."""
    fractions = itertools.product(m.element, POINTS)
    return dict(zip(list(m.tau)[1:], fractions, strict=True))


def _start(m: pyo.ConcreteModel, case: Case, instance: Instance) -> None:
    """Fix the state at t = 0, and make it the initial point for the whole horizon."""
    network = Network(case)
    angles = network.initial_angles(instance).tolist()
    for buses, variable in ((network.generators, m.theta), (network.algebraic, m.angle)):
        for i in buses:
            variable[case.buses[i].id, :].set_value(angles[i])
    for g, p_initial in zip(case.generators, instance.p_initial(case).tolist(), strict=True):
        m.omega[g, :].set_value(0.0)
        m.p_gen[g, :].set_value(p_initial, skip_validation=True)
        m.theta[g, 0].fix()
        m.omega[g, 0].fix(instance.initial.omega[g])
        m.p_gen[g, 0].fix()


def _add_dynamics(m: pyo.ConcreteModel, case: Case, instance: Instance, length: dict[int, float]) -> None:
    """The swing equations at the points, the power flow there and at t = 0; lengths in s."""
    network, points = Network(case), collocation_points(m)
    injection = injections(m, m.tau, case, network)
    times = np.append(0.0, np.cumsum(list(length.values())))
    at = {0.0: 0.0} | {tau: times[e - 1] + c * length[e] for tau, (e, c) in points.items()}
    load = instance.p_load(case)

    def p_load(bus: str, tau: float) -> float:
        """Between grid points loads are taken linear, by everyone."""
        if bus not in case.loads:
            return 0.0
        return float(np.interp(at[tau], instance.grid, load[:, case.loads.index(bus)]))

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
        return injection(bus, tau) == p_load(bus, tau)

    @m.Constraint(m.tau)
    def eq_slack(m: Any, tau: float) -> Any:
        return m.p_slack_up[tau] - m.p_slack_down[tau] == injection(case.slack, tau)


def _add_limits(m: pyo.ConcreteModel, case: Case, bound: float, length: dict[int, float]) -> None:
    """Frequencies at the points, in rad/s, and between them; ramps, for lengths in s."""
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
        rate = (m.p_gen[g, e] - m.p_gen[g, e - 1]) / length[e]
        return pyo.inequality(-ramp[g], rate, ramp[g])


def _add_objective(m: pyo.ConcreteModel, instance: Instance, case: Case, steps: dict[int, int]) -> None:
    """The paper's sum over the grid points, for elements of so many steps of the grid.

    Half of what is at an element's ends and all between, which is exact for generator powers; for |P_s| it is
    the number of grid steps times the mean by Radau's quadrature.
    """
    cost, cost_slack = instance.cost, instance.cost_slack(case)
    weight = dict(zip(POINTS, WEIGHTS, strict=True))

    def p_slack(tau: float) -> Any:
        return m.p_slack_up[tau] + m.p_slack_down[tau]

    def cost_rate(end: int) -> Any:
        return sum(cost[g] * m.p_gen[g, end] for g in m.gen) + cost_slack * p_slack(end)

    @m.Objective()
    def cost_total(m: Any) -> Any:
        generation = sum(
            steps[e] * cost[g] * (m.p_gen[g, e - 1] + m.p_gen[g, e]) / 2 for g in m.gen for e in m.element
        )
        slack = sum(
            weight[c] * steps[e] * cost_slack * p_slack(tau) for tau, (e, c) in collocation_points(m).items()
        )
        return generation + slack + (cost_rate(0) + cost_rate(m.end.last())) / 2
