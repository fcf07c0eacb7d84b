"""The detailed plant linearised along a trajectory, with secondary control.

Between two knots the Jacobian is that of the middle of the interval, with voltages eliminated. From grid
point to grid point it is advanced as the integrator does it: by the polynomial of Kutta's method, which is
stable where the simulation is, and needs two products of matrices where an exponential needs some ten.

States are those of `machine_arrays`, all of one kind together, machines in the order of the generators;
speeds are in rad/s. Last, where there is secondary control, is what it holds (pu): it changes at its times
(`Reset`).
"""

from __future__ import annotations

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.machine_arrays import DELTA, GATE, N_STATES, SPEED, TURBINE
from ded_bench.plants.detailed.power_system import DetailedRun, PowerSystem
from ded_bench.plants.time_varying import (
    Delivered,
    Hold,
    Indices,
    Reset,
    TimeVarying,
    across_intervals,
    repeated,
)
from ded_bench.problem.quantities import Array
from ded_bench.problem.trajectory import Trajectory


def linearised(system: PowerSystem, trajectory: Trajectory, points: Indices) -> TimeVarying:
    """Linearise along a trajectory (see `Plant.linearise_along`).

    Raises:
        InputError: secondary control acts between knots.
    """
    run: DetailedRun = trajectory.states
    n_gen = len(system.case.generators)
    if len(np.setdiff1d(run.agc_points, points)):
        problem = "times of secondary control must be among the knots"
        raise InputError(f"case {system.case.id}", "knots", problem)
    kinds, machines = _states(system)
    order = np.searchsorted(system.moving, kinds * len(system.data) + machines)
    n = len(order) + (system.case.agc is not None)
    scale = np.where(kinds == SPEED, system.data.omega_0[machines], 1.0)
    middle = (points[:-1] + points[1:]) // 2
    drawn = system.p_drawn(trajectory.p_load[middle])
    rates, slack = np.zeros((len(middle), n, n)), np.zeros((len(middle), n))
    for j, k in enumerate(middle):
        x = run.states.x[k].copy()
        x[DELTA] -= system.data.inertia @ x[DELTA]
        slopes = system.slopes(x, run.states.v[k].view(np.complex128), drawn[j])
        rates[j, : len(order), : len(order)] = slopes.rates[np.ix_(order, order)] * (scale[:, None] / scale)
        if not system.island:
            slack[j, : len(order)] = slopes.p_e[system.network.balancing, order] / scale
    into = np.zeros((n, n_gen))
    gates = np.flatnonzero(kinds == GATE)
    for place in gates[:n_gen]:
        into[place, machines[place] == system.scheduled] = system.data.rate_g[machines[place]]
    reset = None
    if (agc := system.case.agc) is not None:
        rates[:, gates, -1] = (system.data.rate_g * system.shares)[machines[gates]]
        f = np.eye(n)
        f[-1] = 0.0
        f[-1, :-1] = np.where(kinds == DELTA, -agc.k * system.data.inertia[machines], 0.0)
        reset = Reset(np.flatnonzero(np.isin(points[:-1], run.agc_points)), f)
    dt_s = float(trajectory.t[1] - trajectory.t[0])
    step = _one_step(rates, into, dt_s, run.steps)
    across = across_intervals(step, np.diff(points))
    if reset is not None:
        across.f[reset.intervals] = across.f[reset.intervals] @ reset.f
    return TimeVarying(
        points=points,
        step=step,
        across=across,
        speed=slice(*(np.flatnonzero(kinds == SPEED)[[0, -1]] + [0, 1]).tolist()),
        slack=slack,
        omega=trajectory.omega,
        p_slack=trajectory.p_slack,
        p_gen=trajectory.p_set[points],
        delivered=_delivered(system, kinds, machines, n, trajectory.p_gen, len(middle)),
        reset=reset,
    )


def _states(system: PowerSystem) -> tuple[Indices, Indices]:
    """Kind and machine of every state that moves; those of the generators first, in their order."""
    n_machine = len(system.data)
    others = np.setdiff1d(np.arange(n_machine), system.scheduled)
    machines = np.tile([*system.scheduled, *others], N_STATES)
    kinds = np.repeat(np.arange(N_STATES), n_machine)
    moves = np.isin(kinds * n_machine + machines, system.moving)
    return kinds[moves], machines[moves]


def _one_step(rates: Array, into: Array, dt_s: float, steps: int) -> Hold:
    """The map of Kutta's method over one grid step, for inputs linear over it.

    Args:
        rates: A, (n_maps, n_state, n_state), 1/s.
        into: B, (n_state, n_gen).
        dt_s: grid step, s.
        steps: of the integrator in it.
    """
    size = dt_s / steps
    z = rates * size
    square = z @ z
    eye = np.eye(z.shape[1])
    f = eye + z + square @ (eye / 2.0 + z / 6.0 + square / 24.0)
    once = np.broadcast_to(size * into, (len(z), *into.shape))
    twice, thrice = z @ once, square @ once
    g = once + twice / 2.0 + thrice / 6.0 + z @ thrice / 24.0
    h = once / 2.0 + twice / 6.0 + thrice / 24.0
    whole = repeated(Hold(f, g, h), steps)
    return Hold(whole.f, whole.g, whole.h / steps)


def _delivered(
    system: PowerSystem, kinds: Indices, machines: Indices, n_state: int, p_gen: Array, n: int
) -> Delivered:
    """Turbines' powers by gates and turbines, the same in all n intervals."""
    n_gen = len(system.scheduled)
    c = np.zeros((n_gen, n_state))
    reheat = system.data.reheat
    for kind, weight in ((GATE, reheat), (TURBINE, 1.0 - reheat)):
        places = np.flatnonzero(kinds == kind)[:n_gen]
        c[np.arange(n_gen), places] = weight[machines[places]]
    return Delivered(np.broadcast_to(c, (n, *c.shape)), np.zeros((n, n_gen, n_gen)), p_gen)
