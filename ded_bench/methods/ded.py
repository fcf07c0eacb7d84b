"""Full DED: the swing DAE discretised by Pyomo.DAE (backward Euler), solved by IPOPT."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo

from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.methods.solvers import Compiled, compile_model
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.swing import Network

#: Solver by settings slug; both start cold and use IPOPT's default tolerances.
SETTINGS = {"default": "ipopt", "executable": "ipopt-executable"}


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; one compiled model per process serves them all."""
    case.check_regimes([regime])

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        model = _built(case, instance.steps, instance.dt_s)
        set_instance(model, case, instance, regime)
        build_s = time.perf_counter() - started
        compiled = _compiled(case, instance.steps, instance.dt_s, settings.name)
        outcome = compiled.solve(settings.time_limit_s)
        return Solution(
            status=outcome.status,
            schedule=schedule_of(model, case, instance) if outcome.has_values else None,
            iterations=outcome.iterations,
            build_s=build_s,
            setup_s=outcome.setup_s,
            solve_s=outcome.solve_s,
            solver_objective=outcome.objective,
            solver_version=outcome.version,
            error="" if outcome.has_values else outcome.message,
        )

    return solve


@functools.lru_cache(maxsize=1)
def _built(case: Case, steps: int, dt: float) -> pyo.ConcreteModel:
    return build_ded(case, steps, dt)


@functools.lru_cache(maxsize=1)
def _compiled(case: Case, steps: int, dt: float, slug: str) -> Compiled:
    return compile_model(_built(case, steps, dt), SETTINGS[slug])


def build_ded(case: Case, steps: int, dt: float) -> pyo.ConcreteModel:
    """Return the unsolved DED of the paper's eq. (DED_OG) for any instance of a case.

    What instances differ in - costs, loads, initial values, the regime's bound - are variables
    that `set_instance` fixes by their bounds.
    """
    network = Network(case)
    m = pyo.ConcreteModel()
    m.t = dae.ContinuousSet(bounds=(0, steps * dt))
    m.gen = pyo.Set(initialize=case.generators, ordered=True)
    m.algebraic = pyo.Set(initialize=[case.buses[i].id for i in network.algebraic], ordered=True)
    m.load_bus = pyo.Set(initialize=case.loads, ordered=True)

    # Data, fixed by bounds.
    m.cost = pyo.Var(m.gen, initialize=0.5)
    m.cost_slack = pyo.Var(initialize=0.5)
    m.p_load = pyo.Var(m.load_bus, m.t, initialize=0.0)

    # Variables; angles in rad, frequencies in rad/s, powers in pu.
    m.theta = pyo.Var(m.gen, m.t, initialize=0.0)
    m.omega = pyo.Var(m.gen, m.t, initialize=0.0)
    m.dtheta = dae.DerivativeVar(m.theta, wrt=m.t, initialize=0.0)
    m.domega = dae.DerivativeVar(m.omega, wrt=m.t, initialize=0.0)
    m.angle = pyo.Var(m.algebraic, m.t, initialize=0.0)
    m.p_gen = pyo.Var(m.gen, m.t, initialize=0.0)
    m.p_slack_up = pyo.Var(m.t, bounds=(0, None), initialize=0.0)
    m.p_slack_down = pyo.Var(m.t, bounds=(0, None), initialize=0.0)
    pyo.TransformationFactory("dae.finite_difference").apply_to(m, nfe=steps, wrt=m.t, scheme="BACKWARD")
    times = list(m.t)
    m.step = pyo.RangeSet(1, steps)

    # Constraints.
    neighbours: dict[str, list[tuple[str, float]]] = {bus.id: [] for bus in case.buses}
    for line, coupling in zip(case.lines, network.coupling.tolist(), strict=True):
        neighbours[line.from_bus].append((line.to_bus, coupling))
        neighbours[line.to_bus].append((line.from_bus, coupling))

    def angle(bus: str, t: float) -> Any:
        return 0.0 if bus == case.slack else m.theta[bus, t] if bus in m.gen else m.angle[bus, t]

    def injection(bus: str, t: float) -> Any:
        return sum(b * pyo.sin(angle(bus, t) - angle(other, t)) for other, b in neighbours[bus])

    @m.Constraint(m.gen, m.t)
    def eq_swing(m: Any, g: str, t: float) -> Any:
        if t == 0:
            return pyo.Constraint.Skip  # the initial state is given; Euler starts at t_1
        machine = case.machines[g]
        return machine.m * m.domega[g, t] + machine.d * m.omega[g, t] == m.p_gen[g, t] - injection(g, t)

    @m.Constraint(m.gen, m.t)
    def eq_angle(m: Any, g: str, t: float) -> Any:
        return pyo.Constraint.Skip if t == 0 else m.dtheta[g, t] == m.omega[g, t]

    @m.Constraint(m.algebraic, m.t)
    def eq_load(m: Any, bus: str, t: float) -> Any:
        return injection(bus, t) == (m.p_load[bus, t] if bus in m.load_bus else 0.0)

    @m.Constraint(m.t)
    def eq_slack(m: Any, t: float) -> Any:
        return m.p_slack_up[t] - m.p_slack_down[t] == injection(case.slack, t)

    @m.Constraint(m.gen, m.step)
    def ineq_ramp(m: Any, g: str, k: int) -> Any:
        rate = (m.p_gen[g, times[k]] - m.p_gen[g, times[k - 1]]) / dt
        return pyo.inequality(-case.ramp_pu_per_s, rate, case.ramp_pu_per_s)

    @m.Objective()
    def cost_total(m: Any) -> Any:
        generation = sum(m.cost[g] * m.p_gen[g, t] for g in m.gen for t in times)
        return generation + sum(m.cost_slack * (m.p_slack_up[t] + m.p_slack_down[t]) for t in times)

    return m


def set_instance(m: pyo.ConcreteModel, case: Case, instance: Instance, regime: str) -> None:
    """Fix a built model's data to one instance and reset its initial point (cold start).

    The initial point is the state at t = 0 held for the whole horizon.
    """
    network = Network(case)
    angles = network.initial_angles(instance)
    p_initial = instance.p_initial(case)
    omega_initial = instance.omega_initial(case)
    p_slack = float(network.injections(angles)[network.slack])
    bound = case.omega_bound(regime)
    times = list(m.t)
    for g in case.generators:
        _fix(m.cost[g], instance.cost[g])
    _fix(m.cost_slack, instance.cost_slack(case))
    for bus, column in zip(case.loads, instance.p_load(case).T.tolist(), strict=True):
        for t, value in zip(times, column, strict=True):
            _fix(m.p_load[bus, t], value)
    for j, g in enumerate(case.generators):
        machine, theta = case.machines[g], float(angles[network.generators[j]])
        for t in times:
            _reset(m.p_gen[g, t], float(p_initial[j]), machine.p_min, machine.p_max)
            _reset(m.omega[g, t], 0.0, -bound, bound)
            _reset(m.theta[g, t], theta)
            m.dtheta[g, t].set_value(0.0)
            m.domega[g, t].set_value(0.0)
        _fix(m.p_gen[g, 0], float(p_initial[j]))
        _fix(m.omega[g, 0], float(omega_initial[j]))
        _fix(m.theta[g, 0], theta)
    for i in network.algebraic:
        for t in times:
            m.angle[case.buses[i].id, t].set_value(float(angles[i]))
    for t in times:
        m.p_slack_up[t].set_value(max(p_slack, 0.0))
        m.p_slack_down[t].set_value(max(-p_slack, 0.0))


def _fix(variable: pyo.Var, value: float) -> None:
    _reset(variable, value, value, value)


def _reset(variable: pyo.Var, value: float, lower: float | None = None, upper: float | None = None) -> None:
    variable.setlb(lower)
    variable.setub(upper)
    variable.set_value(value, skip_validation=True)


def schedule_of(m: pyo.ConcreteModel, case: Case, instance: Instance) -> Schedule:
    """Read the generator powers of a solved model as a schedule on the instance's grid."""
    values: Array = np.array([[m.p_gen[g, t].value for g in case.generators] for t in m.t])
    return Schedule(t=instance.grid, p=values)
