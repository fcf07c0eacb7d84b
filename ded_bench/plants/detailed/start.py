"""The state at t = 0 of an instance: at rest in an equilibrium, or as measured."""

from __future__ import annotations

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.power_flow import MISMATCH, NEWTON_STEPS, OperatingPoint
from ded_bench.plants.detailed.power_system import DetailedState, PowerSystem, interleaved
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import Array, Indices

#: What powers and loads of an instance may leave to the machine that balances the power flow, pu.
REMAINDER = 1e-4
#: States that a measurement does not give, and that are stationary in it.
STATIONARY = (at.E1Q, at.E1D, at.E2D, at.E2Q, at.EXCITER, at.FIELD, at.FEEDBACK)


def initial_point(system: PowerSystem, instance: Instance) -> OperatingPoint:
    """The power flow of the initial powers and loads; one machine takes what these are short of.

    Raises:
        InputError: that is more than REMAINDER, on an island and at rest.
        SimulationError: there is no solution.
    """
    wanted = system.p_machine(instance.p_initial(system.case))
    drawn = system.p_drawn(instance.p_load(system.case, np.zeros(1)))[0]
    point, balancing = system.network.power_flow(wanted, drawn), system.network.balancing
    short = float(point.power.real[balancing] - wanted[balancing])
    if system.island and instance.initial.measured is None and abs(short) > REMAINDER:
        problem = f"initial loads and losses exceed power by {short:.3g} pu, more than {REMAINDER:g} in size"
        raise InputError(f"instance {instance.id}", "initial.power", problem)
    return point


def start(system: PowerSystem, instance: Instance) -> DetailedState:
    """The state at t = 0.

    Voltages at machines are nominal in the power flow of the initial powers and loads, which gives the
    exciters' references. At rest, what the powers lack goes to the machine that balances the power flow,
    whose governor's reference is off its set-point by it. A measured state has that of its set-points and
    secondary control; fluxes, exciters and stabilisers are stationary.

    Raises:
        InputError: see `initial_point`; or there are angles, and no island.
        SimulationError: there is no equilibrium.
    """
    case, data, machines = system.case, system.data, system.scheduled
    p_set = instance.p_initial(case)
    point = initial_point(system, instance)
    x, v_ref = system.equilibrium(point)
    offset = point.power.real.copy()
    offset[machines] -= p_set
    mean = float(data.inertia @ x[at.DELTA])
    x[at.DELTA] -= mean
    v = interleaved(point.voltage * np.exp(-1j * mean))
    x[at.SPEED, machines] = instance.omega_initial(case) / data.omega_0[machines]
    held, next_s = 0.0, 0.0 if case.agc is None else case.agc.period_s
    if instance.initial.measured is None:
        return DetailedState(x, v, held, next_s, v_ref, offset, p_set)
    offset[machines] = 0.0
    if (theta := instance.theta_initial(case)) is not None:
        if not system.island:
            problem = "angles behind an infinite slack are those of another plant than this"
            raise InputError(f"instance {instance.id}", "initial.theta", problem)
        x[at.DELTA, machines] = theta
        x[at.DELTA] -= data.inertia @ x[at.DELTA]
        v = _stationary(system, x, v, point.p_drawn, v_ref)
    if (agc := instance.initial.agc) is not None:
        held, next_s = agc.held_pu, next_s if agc.next_s is None else agc.next_s
        x[at.DELTA] += agc.integral_rad
    reference = offset.copy()
    reference[machines] += p_set
    reference += held * system.shares
    mechanical = reference.copy()
    if (given := instance.mechanical_initial(case)) is not None:
        mechanical[machines] = given
    x[at.GATE] = reference - data.droop * x[at.SPEED]
    x[at.TURBINE] = _turbine(system, x, mechanical)
    x[at.WASHOUT] = data.ks * x[at.SPEED]
    x[at.LEAD_A] = x[at.LEAD_B] = 0.0
    return DetailedState(x, v, held, next_s, v_ref, offset, p_set)


def corrected(system: PowerSystem, instance: Instance, estimate: DetailedState) -> DetailedState:
    """An estimate of the state at t = 0 with what an instance has measured of it in its place."""
    case, data, machines = system.case, system.data, system.scheduled
    x = estimate.x.copy()
    x[at.SPEED, machines] = instance.omega_initial(case) / data.omega_0[machines]
    if (theta := instance.theta_initial(case)) is not None:
        x[at.DELTA, machines] = theta
        x[at.DELTA] -= data.inertia @ x[at.DELTA]
    held, next_s = estimate.held, estimate.next_s
    if (agc := instance.initial.agc) is not None:
        held, next_s = agc.held_pu, next_s if agc.next_s is None else agc.next_s
        x[at.DELTA] += agc.integral_rad
    if (mechanical := instance.mechanical_initial(case)) is not None:
        x[at.TURBINE, machines] = _turbine(system, x, mechanical, machines)
    return estimate._replace(x=x, held=held, next_s=next_s, p_set=instance.p_initial(case), carried=None)


def _turbine(
    system: PowerSystem, x: Array, mechanical: Array, machines: Indices | slice = slice(None)
) -> Array:
    """States of turbines that deliver given powers, (n,), pu; those of gates where they do not lag."""
    gate, reheat = x[at.GATE, machines], system.data.reheat[machines]
    through, lagging = 1.0 - reheat, gate.copy()
    np.divide(mechanical - reheat * gate, through, out=lagging, where=through != 0.0)
    return lagging


def _stationary(system: PowerSystem, x: Array, v: Array, drawn: Array, v_ref: Array) -> Array:
    """Set fluxes and exciters so that they are stationary at given rotor angles; return the voltages.

    Newton's method on their rates and the network's balance.

    Raises:
        SimulationError: there is no such state.
    """
    n, n_v = x.shape[1], len(v)
    moving = system.moving
    free = moving[np.isin(moving // n, STATIONARY)]
    rows = np.concatenate([free, at.N_STATES * n + np.arange(n_v)])
    speed, x[at.SPEED] = x[at.SPEED].copy(), 0.0  # stabilisers have nothing to say in a stationary state
    still = np.zeros(n)
    for _ in range(NEWTON_STEPS):
        given = x.ravel(), v, still, drawn, v_ref
        rates, balance, *_ = (part.full().ravel() for part in system.symbolic.equations(*given))
        off = np.concatenate([rates[free], balance])
        worst = np.abs(off).max()
        if worst < MISMATCH * 1e3:
            x[at.SPEED] = speed
            return v
        if not worst < np.inf:
            break
        jacobian = system.symbolic.jacobian(*given).sparse().tocsr()[rows][:, rows]
        step = np.linalg.solve(jacobian.toarray(), off)
        x.flat[free] -= step[: len(free)]
        v = v - step[len(free) :]
    raise SimulationError("there are no stationary fluxes and voltages at the given angles")
