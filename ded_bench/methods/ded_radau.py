"""DED by orthogonal collocation: Pyomo.DAE's Radau scheme on elements that end at the loads' kinks.

The same problem as `ded`, with the DAE discretised to high order: within an element, states are
cubic polynomials that meet the equations at three Radau points, generator powers are linear. What
it costs, in time and accuracy, to use backward Euler instead shows when both are re-simulated.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo
from numpy.typing import NDArray

from ded_bench.methods.ded import answer, injections, power_limits
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import compile_model, fix, reset
from ded_bench.solvers.outcome import Compiled
from ded_bench.truth.network import Network

#: Mean length of an element; the default was chosen on validation instances (docs/model.md).
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "default": {"length_s": 0.1},
    "200ms": {"length_s": 0.2},
    "500ms": {"length_s": 0.5},
    "1s": {"length_s": 1.0},
}
#: Collocation points of the Radau IIA method with three stages, as fractions of an element, and the
#: weights of its quadrature (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5).
POINTS = (0.4 - 6**0.5 / 10, 0.4 + 6**0.5 / 10, 1.0)
WEIGHTS = ((16 - 6**0.5) / 36, (16 + 6**0.5) / 36, 1 / 9)
#: Where else in an element frequencies are bounded: halfway between the points that lie far apart.
BETWEEN = ((POINTS[0] + POINTS[1]) / 2, (POINTS[1] + POINTS[2]) / 2)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; one compiled model per process serves them all."""
    case.check_regimes([regime])

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        elements = element_count(case, instance, **SETTINGS[settings.name])
        model = _built(case, elements)
        set_instance(model, case, instance, regime)
        build_s = time.perf_counter() - started
        outcome = _compiled(case, elements).solve(settings.time_limit_s)
        return answer(outcome, build_s, lambda: schedule_of(model, case, instance))

    return solve


@functools.lru_cache(maxsize=1)
def _built(case: Case, elements: int) -> pyo.ConcreteModel:
    return build_ded_radau(case, elements)


@functools.lru_cache(maxsize=1)
def _compiled(case: Case, elements: int) -> Compiled:
    return compile_model(_built(case, elements), "ipopt")


def element_count(case: Case, instance: Instance, length_s: float) -> int:
    """Number of elements of about a given length; for loads that ramp once it depends on the horizon only."""
    pieces = 2 * len(case.loads) + 1  # a load ramp starts and ends: what lies between needs an element
    pieces = max(pieces, len(_kinks(instance)) - 1)
    return min(max(round(instance.horizon_s / length_s), pieces), instance.steps)


def _kinks(instance: Instance) -> list[int]:
    """Grid indices k of the kinks of the loads, rounded, with the first and the last point of the grid."""
    kinks = [t for load in instance.load.values() for t in load.kinks]
    places = {round(t / instance.dt_s) for t in kinks if t < instance.horizon_s}
    return sorted(places | {0, instance.steps})


def element_ends(instance: Instance, elements: int) -> NDArray[np.int_]:
    """Grid indices k of the element ends, shape (elements + 1,), from 0 to the last.

    Every kink of a load is an end, rounded to the grid; between kinks the elements are of nearly equal
    length, and the longest is as short as can be.
    """
    pieces = list(itertools.pairwise(_kinks(instance)))
    counts = [1] * len(pieces)
    for _ in range(elements - len(pieces)):
        lengths = [(b - a) / count for (a, b), count in zip(pieces, counts, strict=True)]
        counts[lengths.index(max(lengths))] += 1
    inner = [np.linspace(a, b, count + 1).round()[:-1] for (a, b), count in zip(pieces, counts, strict=True)]
    return np.append(np.concatenate(inner), instance.steps).astype(int)


def build_ded_radau(case: Case, elements: int) -> pyo.ConcreteModel:
    """Return the unsolved DED of the paper's eq. (DED_OG), discretised by collocation.

    Time is scaled so that every element has length one: dx/dτ = h dx/dt. The lengths h are data like
    costs, loads, initial values and the regime's bound: `set_instance` fixes them by bounds.

    Frequencies are bounded at the collocation points and `BETWEEN` them. The objective is the paper's
    sum over the grid points t_k: half of what is at an element's ends and all between, which is exact for
    generator powers; for |P_s| it is the number of grid steps times the mean by Radau's quadrature.
    """
    network, ramp = Network(case), dict(zip(case.generators, case.ramp.tolist(), strict=True))
    m = pyo.ConcreteModel()
    m.tau = dae.ContinuousSet(bounds=(0, elements))
    m.element = pyo.RangeSet(1, elements)
    m.end = pyo.RangeSet(0, elements)
    m.gen = pyo.Set(initialize=case.generators, ordered=True)
    m.algebraic = pyo.Set(initialize=[case.buses[i].id for i in network.algebraic], ordered=True)
    m.load_bus = pyo.Set(initialize=case.loads, ordered=True)

    # Data, fixed by bounds; lengths in s, and in steps of the grid.
    m.cost = pyo.Var(m.gen, initialize=0.5)
    m.cost_slack = pyo.Var(initialize=0.5)
    m.length = pyo.Var(m.element, initialize=1.0)
    m.steps = pyo.Var(m.element, initialize=1.0)
    m.p_load = pyo.Var(m.load_bus, m.tau, initialize=0.0)

    # Variables; angles in rad, frequencies in rad/s, powers in pu.
    m.theta = pyo.Var(m.gen, m.tau, initialize=0.0)
    m.omega = pyo.Var(m.gen, m.tau, initialize=0.0)
    m.dtheta = dae.DerivativeVar(m.theta, wrt=m.tau, initialize=0.0)
    m.domega = dae.DerivativeVar(m.omega, wrt=m.tau, initialize=0.0)
    m.omega_between = pyo.Var(m.gen, m.element, BETWEEN, initialize=0.0)
    m.angle = pyo.Var(m.algebraic, m.tau, initialize=0.0)
    m.p_gen = pyo.Var(m.gen, m.end, bounds=power_limits(case))
    m.p_slack_up = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    m.p_slack_down = pyo.Var(m.tau, bounds=(0, None), initialize=0.0)
    pyo.TransformationFactory("dae.collocation").apply_to(
        m, wrt=m.tau, nfe=elements, ncp=len(POINTS), scheme="LAGRANGE-RADAU"
    )
    places, taus = collocation_points(m), list(m.tau)

    # Constraints.
    injection = injections(m, case, network)

    @m.Constraint(m.gen, places)
    def eq_swing(m: Any, g: str, tau: float) -> Any:
        (e, c), machine = places[tau], case.machines[g]
        power = (1 - c) * m.p_gen[g, e - 1] + c * m.p_gen[g, e]
        force = power - injection(g, tau) - machine.d * m.omega[g, tau]
        return machine.m * m.domega[g, tau] == m.length[e] * force

    @m.Constraint(m.gen, places)
    def eq_angle(m: Any, g: str, tau: float) -> Any:
        return m.dtheta[g, tau] == m.length[places[tau][0]] * m.omega[g, tau]

    @m.Constraint(m.gen, m.element, BETWEEN)
    def eq_between(m: Any, g: str, e: int, c: float) -> Any:
        values = [m.omega[g, tau] for tau in taus[3 * (e - 1) : 3 * e + 1]]
        return m.omega_between[g, e, c] == sum(a * v for a, v in zip(lagrange(c), values, strict=True))

    @m.Constraint(m.algebraic, m.tau)
    def eq_load(m: Any, bus: str, tau: float) -> Any:
        return injection(bus, tau) == (m.p_load[bus, tau] if bus in m.load_bus else 0.0)

    @m.Constraint(m.tau)
    def eq_slack(m: Any, tau: float) -> Any:
        return m.p_slack_up[tau] - m.p_slack_down[tau] == injection(case.slack, tau)

    @m.Constraint(m.gen, m.element)
    def ineq_ramp(m: Any, g: str, e: int) -> Any:
        rate = (m.p_gen[g, e] - m.p_gen[g, e - 1]) / m.length[e]
        return pyo.inequality(-ramp[g], rate, ramp[g])

    def cost_rate(end: int) -> Any:
        generation = sum(m.cost[g] * m.p_gen[g, end] for g in m.gen)
        return generation + m.cost_slack * (m.p_slack_up[end] + m.p_slack_down[end])

    @m.Objective()
    def cost_total(m: Any) -> Any:
        weight = dict(zip(POINTS, WEIGHTS, strict=True))
        generation = sum(
            m.steps[e] * m.cost[g] * (m.p_gen[g, e - 1] + m.p_gen[g, e]) / 2 for g in m.gen for e in m.element
        )
        slack = sum(
            weight[c] * m.steps[e] * m.cost_slack * (m.p_slack_up[tau] + m.p_slack_down[tau])
            for tau, (e, c) in places.items()
        )
        return generation + slack + (cost_rate(0) + cost_rate(elements)) / 2

    return m


def collocation_points(m: pyo.ConcreteModel) -> dict[float, tuple[int, float]]:
    """The points of a discretised model, in order: τ as its index says, the element, the fraction in it."""
    fractions = itertools.product(m.element, POINTS)
    return dict(zip(list(m.tau)[1:], fractions, strict=True))


def lagrange(c: float) -> list[float]:
    """Weights of a cubic's values at 0 and the collocation points that give its value at `c`."""
    nodes = (0.0, *POINTS)
    return [math.prod((c - b) / (a - b) for b in nodes if b != a) for a in nodes]


def set_instance(m: pyo.ConcreteModel, case: Case, instance: Instance, regime: str) -> None:
    """Fix a built model's data to one instance and reset its initial point (cold start).

    The initial point is the state at t = 0 held for the whole horizon.
    """
    network = Network(case)
    angles = network.initial_angles(instance)
    p_initial = instance.p_initial(case)
    p_slack = float(network.injections(angles)[network.slack])
    bound = case.omega_bound(regime)
    for g in case.generators:
        fix(m.cost[g], instance.cost[g])
    fix(m.cost_slack, instance.cost_slack(case))
    for e, steps in zip(m.element, np.diff(element_ends(instance, len(m.element))), strict=True):
        fix(m.steps[e], float(steps))
        fix(m.length[e], float(steps) * instance.dt_s)
    times, load = point_times(m), instance.p_load(case)
    for bus, column in zip(case.loads, load.T, strict=True):
        # Between grid points loads are taken linear, by everyone.
        for tau, value in zip(m.tau, np.interp(times, instance.grid, column).tolist(), strict=True):
            fix(m.p_load[bus, tau], value)
    for j, g in enumerate(case.generators):
        theta = float(angles[network.generators[j]])
        for end in m.end:
            m.p_gen[g, end].set_value(float(p_initial[j]), skip_validation=True)
        for tau in m.tau:
            reset(m.omega[g, tau], 0.0, -bound, bound)
            reset(m.theta[g, tau], theta)
            m.dtheta[g, tau].set_value(0.0)
            m.domega[g, tau].set_value(0.0)
        for e, c in itertools.product(m.element, BETWEEN):
            reset(m.omega_between[g, e, c], 0.0, -bound, bound)
        fix(m.p_gen[g, 0], float(p_initial[j]))
        fix(m.omega[g, 0], instance.initial.omega[g])
        fix(m.theta[g, 0], theta)
    for i in network.algebraic:
        for tau in m.tau:
            m.angle[case.buses[i].id, tau].set_value(float(angles[i]))
    for tau in m.tau:
        m.p_slack_up[tau].set_value(max(p_slack, 0.0))
        m.p_slack_down[tau].set_value(max(-p_slack, 0.0))


def point_times(m: pyo.ConcreteModel) -> Array:
    """Times of a model's points τ for the instance it is set to, shape (3 elements + 1,), s."""
    lengths = [m.length[e].value for e in m.element]
    starts = np.append(0.0, np.cumsum(lengths))
    inner = [starts[e - 1] + c * lengths[e - 1] for e, c in collocation_points(m).values()]
    return np.array([0.0, *inner])


def schedule_of(m: pyo.ConcreteModel, case: Case, instance: Instance) -> Schedule:
    """Read the generator powers of a solved model as a schedule with one row per element end.

    IPOPT relaxes bounds by 1e-8 of their size; powers are put back, which makes no ramp steeper.
    """
    ends = element_ends(instance, len(m.element))
    values: Array = np.array([[m.p_gen[g, end].value for g in case.generators] for end in m.end])
    return Schedule(t=instance.grid[ends], p=np.clip(values, case.p_min, case.p_max))
