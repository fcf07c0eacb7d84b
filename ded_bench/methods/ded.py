"""Full DED: the swing DAE discretised by Pyomo.DAE (backward Euler), solved by IPOPT."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo

from ded_bench.methods.euler_program import EulerPrograms
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution, Solver, answer, too_large
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.lossless_case import lossless
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import fix
from ded_bench.solvers.ipopt import CasadiIpopt
from ded_bench.solvers.linear_program import assign
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1
#: An array of Pyomo's variables or expressions.
Expressions: TypeAlias = "np.ndarray[Any, Any]"
#: One solution of the linear system per iteration, refined only where its residual asks for it: the
#: iterates are the same, without a tenth of the time.
_IPOPT_OPTIONS = {"min_refinement_steps": 0}
#: Memory that model and solver take for each line and point: the peak of a process that solves one instance
#: in TO, less what imports take, was 12 KB on two-area (1.2 GiB in all) and 11 KB on 39bus (3.6 GiB). After
#: several instances it is 4.2 GiB there.
BYTES_PER_FLOW = 12_000
#: Memory for each entry of the stiffness of all points, as linear programs take it: the peak on 39bus.
BYTES_PER_ENTRY = 28


@dataclass(frozen=True)
class Options:
    """How the program is solved."""

    accelerated: bool = option(False, "linear programs first; IPOPT where they do not get through")


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; one compiled model per process serves them all."""
    solve = _accelerated if read_options(Options, settings.options).accelerated else _solve
    return functools.partial(solve, case, regime, settings.time_limit_s)


def _solve(case: Case, regime: str, time_limit_s: float | None, instance: Instance) -> Solution:
    """IPOPT on the whole program."""
    needed = BYTES_PER_FLOW * len(lossless(case).lines) * (instance.steps + 1)
    if refusal := too_large(needed, "the Pyomo model", "`ded-slp` takes less"):
        return refusal
    started = time.perf_counter()
    model = _built(case, instance.steps, instance.dt_s)
    set_instance(model, case, instance, regime)
    build_s = time.perf_counter() - started
    return answer(_compiled(model).solve(time_limit_s), build_s, lambda: schedule_of(model, instance))


def _accelerated(case: Case, regime: str, time_limit_s: float | None, instance: Instance) -> Solution:
    """Linear programs; where they do not get through, IPOPT decides in what is left of the time."""
    needed = BYTES_PER_ENTRY * (instance.steps + 1) * case.n_bus**2
    if refusal := too_large(needed, "the sequence of programs", "`ded-slp` takes less"):
        return refusal
    started = time.perf_counter()
    programs = _programs(case, regime, instance.steps, instance.dt_s)
    build_s = time.perf_counter() - started
    found = programs.solve(instance, time_limit_s)
    if found.status != Status.FAILED:
        return dataclasses.replace(found, build_s=build_s)
    spent_s = found.solve_s or 0.0
    rest = None if time_limit_s is None else max(time_limit_s - spent_s, 1e-3)
    verdict = _solve(case, regime, rest, instance)
    return dataclasses.replace(
        verdict,
        iterations=(verdict.iterations or 0) + (found.iterations or 0),
        solve_s=(verdict.solve_s or 0.0) + spent_s,
        solver_version=f"{found.solver_version}, {verdict.solver_version}".removeprefix(", "),
    )


def build_ded(case: Case, steps: int, dt: float) -> pyo.ConcreteModel:
    """Return the unsolved DED of the paper's eq. (DED_OG) for any instance of a case.

    What instances differ in - costs, loads, initial values, the regime's bound - are variables
    that `set_instance` fixes by their bounds.
    """
    network, m = Network(case), pyo.ConcreteModel()
    m.t = dae.ContinuousSet(bounds=(0, steps * dt))
    m.algebraic = pyo.Set(initialize=[network.case.buses[i].id for i in network.algebraic], ordered=True)

    # Variables; angles in rad, frequencies in rad/s, powers in pu.
    add_powers(m, case, m.t)
    m.theta = pyo.Var(m.gen, m.t, initialize=0.0)
    m.omega = pyo.Var(m.gen, m.t, initialize=0.0)
    m.dtheta = dae.DerivativeVar(m.theta, wrt=m.t, initialize=0.0)
    m.domega = dae.DerivativeVar(m.omega, wrt=m.t, initialize=0.0)
    m.angle = pyo.Var(m.algebraic, m.t, initialize=0.0)
    pyo.TransformationFactory("dae.finite_difference").apply_to(m, nfe=steps, wrt=m.t, scheme="BACKWARD")
    theta_rate, omega_rate = eliminated(m, m.dtheta), eliminated(m, m.domega)

    injection = injections(m, case, network)

    @m.Constraint(m.gen, m.t)
    def eq_swing(m: Any, g: str, t: float) -> Any:
        if t == 0:
            return pyo.Constraint.Skip  # the initial state is given; Euler starts at t_1
        machine = case.machines[g]
        return machine.m * omega_rate[g, t] + machine.d * m.omega[g, t] == m.p_gen[g, t] - injection(g, t)

    @m.Constraint(m.gen, m.t)
    def eq_angle(m: Any, g: str, t: float) -> Any:
        return pyo.Constraint.Skip if t == 0 else theta_rate[g, t] == m.omega[g, t]

    @m.Constraint(m.algebraic, m.t)
    def eq_load(m: Any, bus: str, t: float) -> Any:
        return injection(bus, t) == (m.p_load[bus, t] if bus in m.load_bus else 0.0)

    @m.Constraint(m.t)
    def eq_slack(m: Any, t: float) -> Any:
        return m.p_slack_up[t] - m.p_slack_down[t] == injection(network.case.slack, t)

    add_ramps_and_cost(m, case, list(m.t), dt)
    return m


_built = functools.lru_cache(maxsize=1)(build_ded)
_compiled = functools.lru_cache(maxsize=1)(functools.partial(CasadiIpopt, options=_IPOPT_OPTIONS))
_programs = functools.lru_cache(maxsize=2)(EulerPrograms)


def add_powers(m: pyo.ConcreteModel, case: Case, points: Any) -> None:
    """Declare what any program over all points has: powers, pu, and data that `set_powers` fixes."""
    m.gen = pyo.Set(initialize=case.generators, ordered=True)
    m.load_bus = pyo.Set(initialize=case.loads, ordered=True)
    m.cost, m.cost_slack = pyo.Var(m.gen, initialize=0.5), pyo.Var(initialize=0.5)
    m.p_load = pyo.Var(m.load_bus, points, initialize=0.0)
    m.p_gen = pyo.Var(m.gen, points, bounds=lambda m, g, t: (case.machines[g].p_min, case.machines[g].p_max))
    m.p_slack_up = pyo.Var(points, bounds=(0, None), initialize=0.0)
    m.p_slack_down = pyo.Var(points, bounds=(0, None), initialize=0.0)


def add_ramps_and_cost(m: pyo.ConcreteModel, case: Case, points: Sequence[Any], dt: float) -> None:
    """Declare the paper's limits of ramps, and its objective."""
    m.step = pyo.RangeSet(1, len(points) - 1)
    ramp = dict(zip(case.generators, case.ramp.tolist(), strict=True))

    @m.Constraint(m.gen, m.step)
    def ineq_ramp(m: Any, g: str, k: int) -> Any:
        rate = (m.p_gen[g, points[k]] - m.p_gen[g, points[k - 1]]) / dt
        return pyo.inequality(-ramp[g], rate, ramp[g])

    @m.Objective()
    def cost_total(m: Any) -> Any:
        generation = pyo.quicksum(m.cost[g] * m.p_gen[g, t] for g in m.gen for t in points)
        slack = pyo.quicksum(m.cost_slack * (m.p_slack_up[t] + m.p_slack_down[t]) for t in points)
        return generation + slack


def eliminated(m: pyo.ConcreteModel, derivative: dae.DerivativeVar) -> dict[Any, Any]:
    """Take a discretised derivative out of a model; return the difference quotients that stand for it.

    IPOPT takes the same iterates, on a linear system with a fifth fewer rows.
    """
    equations = m.component(f"{derivative.local_name}_disc_eq")
    quotients = {index: equations[index].expr.args[1] for index in equations}
    m.del_component(equations)
    m.del_component(derivative)
    return quotients


def injections(m: pyo.ConcreteModel, case: Case, network: Network) -> Callable[[str, float], Any]:
    """f_i(θ(t)) of the paper as a function of bus and time, over a model's `theta` and `angle`, pu.

    The model gets `line` and `flow`: every line's flow is one named expression that both of its ends share, a
    third less memory than with the sines of either end for themselves.
    """
    leaving: dict[str, list[int]] = {bus.id: [] for bus in network.case.buses}
    arriving: dict[str, list[int]] = {bus.id: [] for bus in network.case.buses}
    for number, line in enumerate(network.case.lines):
        leaving[line.from_bus].append(number)
        arriving[line.to_bus].append(number)
    m.line = pyo.RangeSet(0, len(network.case.lines) - 1)

    def angle(bus: str, t: float) -> Any:
        return 0.0 if bus == case.slack else m.theta[bus, t] if bus in m.gen else m.angle[bus, t]

    @m.Expression(m.line, m.t)
    def flow(m: Any, number: int, t: float) -> Any:
        line = network.case.lines[number]
        return float(network.coupling[number]) * pyo.sin(angle(line.from_bus, t) - angle(line.to_bus, t))

    def injection(bus: str, t: float) -> Any:
        outward = sum(m.flow[number, t] for number in leaving[bus])
        return outward - sum(m.flow[number, t] for number in arriving[bus])

    return injection


def set_instance(m: pyo.ConcreteModel, case: Case, instance: Instance, regime: str) -> None:
    """Fix a built model's data to one instance and reset its initial point (cold start).

    The initial point is the state at t = 0 held for the whole horizon.
    """
    network = Network(case)
    angles, bound = network.initial_angles(instance), case.omega_bound(regime)
    set_powers(m, case, instance, float(network.injections(angles)[network.slack]))
    theta, omega, angle = (_over_time(m, name) for name in ("theta", "omega", "angle"))
    if omega[-1, 0].ub != bound:  # the model was set to another regime before, or to none
        for variable in omega.flat:
            variable.setlb(-bound)
            variable.setub(bound)
    of_generators, others = angles[network.generators], angles[network.algebraic]
    for variables, values in ((theta, of_generators), (omega, np.zeros_like(of_generators)), (angle, others)):
        assign(variables.ravel(), np.broadcast_to(values, variables.shape).ravel())
    for variables, values in ((theta, of_generators), (omega, instance.omega_initial(case))):
        for variable, value in zip(variables[0], values.tolist(), strict=True):
            fix(variable, value)


def set_powers(m: pyo.ConcreteModel, case: Case, instance: Instance, p_slack: float) -> None:
    """Fix costs, loads and P_0; powers start as they are at t = 0, pu."""
    fix(m.cost_slack, instance.cost_slack(case))
    p_initial, p_gen = instance.p_initial(case), _over_time(m, "p_gen")
    up, down = _over_time(m, "p_slack_up"), _over_time(m, "p_slack_down")
    for variables, start in ((p_gen, p_initial), (up, max(p_slack, 0.0)), (down, max(-p_slack, 0.0))):
        assign(variables.ravel(), np.broadcast_to(start, variables.shape).ravel())
    for variables, values in (
        (np.array(list(m.cost.values())), instance.cost_gen(case)),
        (_over_time(m, "p_load"), instance.p_load(case)),
        (p_gen[0], p_initial),
    ):
        for variable, value in zip(variables.flat, values.ravel().tolist(), strict=True):
            fix(variable, value)


@functools.lru_cache(maxsize=7)  # as many as are asked for of one model, which keep it alive
def _over_time(m: pyo.ConcreteModel, name: str) -> Expressions:
    """A variable of every point, (n_points, n_index); to look it up takes longer than to set it."""
    return by_time(m.component(name), m.p_slack_up)


def by_time(variable: pyo.Var, times: Any) -> Expressions:
    """The variables of an indexed one, (n_times, n_index)."""
    return np.array(list(variable.values()), dtype=object).reshape(-1, len(times)).T


def schedule_of(m: pyo.ConcreteModel, instance: Instance) -> Schedule:
    """Read the generator powers of a solved model as a schedule on the instance's grid."""
    return Schedule(t=instance.grid, p=np.vectorize(pyo.value, otypes=[float])(_over_time(m, "p_gen")))
