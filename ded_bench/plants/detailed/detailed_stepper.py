"""The plant integrated by Kutta's method of order 4 with steps of fixed length; compiled.

No mode of the shipped grids is faster than 160 1/s, so that the method is stable with steps of 0.01 s, the
distance of grid points. It is accurate far below a millionth of a Hz for the modes that move, all slower
than 30 1/s. An implicit method would solve with a full matrix in every step, where this one multiplies
with the loads' part of it, and it would not need fewer steps: set-points and loads have kinks at grid points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.plants.detailed.equations import (
    FIXED_POINT_STEPS,
    CompiledNetwork,
    LoadSlopes,
    machine_rates,
    mean_angle,
    renew,
    solve_afresh,
    solve_voltages,
    sources,
)
from ded_bench.plants.detailed.machine_arrays import GATE, SPEED, TURBINE, MachineArrays
from ded_bench.problem.compiled import compiled, copy_row, inlined
from ded_bench.problem.quantities import Array, Indices

#: Slopes of loads are renewed where voltages take more fixed-point steps than this, but not within so many
#: integrator steps: an inversion costs as much as some hundred of those.
SLOW, RENEWED_AFTER = 3, 50
#: A point that no grid has.
NEVER = 2**62


class PlantInputs(NamedTuple):
    """What drives the plant at n points of time, linear between them."""

    p_set: Array  # set-points, (n, n_gen), pu
    machine: Indices  # of each generator, (n_gen,)
    offset: Array  # governors' references less set-points, (n_machine,), pu
    p_load: Array  # injections of the case's loads, (n, n_load), pu
    port: Indices  # of each of them, (n_load,)
    p_drawn: Array  # nominal active power at the ports with loads, (n_load_port,), pu
    v_ref: Array  # exciters' references, constant, (n_machine,), pu
    dt: float  # s


class SecondaryControl(NamedTuple):
    """AGC: at its times every machine's share becomes -participation · gain · (mean rotor angle)."""

    participation: Array  # (n_machine,)
    gain: float  # pu/rad
    first: int  # point of its first time; beyond the last: none
    period: int  # points


class DetailedStates(NamedTuple):
    """States at n points of time; the first of `x`, `v` and `held` are given, the others computed."""

    x: Array  # (n, N_STATES, n_machine); the mean rotor angle is the integral of the mean frequency
    v: Array  # voltages at ports in the frame of the mean angle, (n, 2 n_port), pu
    held: Array  # what AGC asks of all machines from each point on, (n,), pu
    p_e: Array  # (n, n_machine), pu
    omega: Array  # of the generators, (n, n_gen), rad/s
    p_gen: Array  # what their turbines deliver, (n, n_gen), pu


class CarriedVoltages(NamedTuple):
    """What goes on from piece to piece, so that pieces are the whole to the last bit."""

    recent: Array  # voltages at each stage of the last four steps, (4, 4, 2 n_load), pu
    load: LoadSlopes
    age: Indices  # integrator steps since the slopes are these, (1,)


def carried_voltages(network: CompiledNetwork, inputs: PlantInputs, v: Array) -> CarriedVoltages:
    """What a state without a past has, at the first loads and voltages (2 n_port,), pu."""
    drawn, n_load = inputs.p_drawn.copy(), len(inputs.p_drawn)
    drawn[inputs.port] = -inputs.p_load[0]
    load = LoadSlopes(np.empty((n_load, 4)), np.empty((len(v), len(v))))
    renew(network, drawn, v, load)
    return CarriedVoltages(np.tile(v[: 2 * n_load], (4, 4, 1)), load, np.zeros(1, dtype=np.intp))


@inlined
def _next_voltages(
    network: CompiledNetwork, drawn: Array, source: Array, carried: CarriedVoltages, s: int, v: Array
) -> bool:
    """Find the voltages of stage s, predicted from those at the same stage of the last four steps.

    Slopes are renewed where they are old; tells whether there is a solution. See `solve_voltages`.
    """
    recent, load, age = carried.recent, carried.load, carried.age
    n = recent.shape[2]
    for i in range(n):
        v[i] = 4.0 * (recent[0, s, i] + recent[2, s, i]) - 6.0 * recent[1, s, i] - recent[3, s, i]
    needed = solve_voltages(network, drawn, source, load, v, FIXED_POINT_STEPS)
    solved = needed <= FIXED_POINT_STEPS
    if not solved:
        for i in range(n):
            v[i] = recent[0, s, i]  # those of the step before
        solved = solve_afresh(network, drawn, source, load, v)
        age[0] = 0
    elif needed > SLOW and age[0] > RENEWED_AFTER:
        renew(network, drawn, v, load)
        age[0] = 0
    for i in range(n):
        recent[3, s, i], recent[2, s, i], recent[1, s, i] = recent[2, s, i], recent[1, s, i], recent[0, s, i]
        recent[0, s, i] = v[i]
    return solved


@inlined
def _set_inputs(inputs: PlantInputs, k: int, p_ref: Array, drawn: Array) -> None:
    """Governors' references without secondary control, and powers of loads, at a point and the next."""
    for end in range(2):
        at = min(k + end, len(inputs.p_set) - 1)
        copy_row(inputs.offset, p_ref[end])
        copy_row(inputs.p_drawn, drawn[end])
        for g, machine in enumerate(inputs.machine):
            p_ref[end, machine] += inputs.p_set[at, g]
        for i, port in enumerate(inputs.port):
            drawn[end, port] = -inputs.p_load[at, i]


@compiled
def integrate_plant(
    data: MachineArrays,
    network: CompiledNetwork,
    inputs: PlantInputs,
    agc: SecondaryControl,
    steps: int,
    carried: CarriedVoltages,
    states: DetailedStates,
) -> int:
    """Integrate from the first point of time to the last; a share due at the last point is not applied.

    Args:
        data, network: the machines, and what is between ports.
        inputs, agc: what drives them at the points, and secondary control.
        steps: integrator steps from one point to the next.
        carried: from the piece before; becomes what the next one needs.
        states: receives what happens.

    Returns:
        The number of points computed: less than n where the network's equations have no solution.
    """
    n, n_machine, n_load, h = len(states.x), states.x.shape[2], len(inputs.p_drawn), inputs.dt / steps
    node, weight = (0.0, 0.5, 0.5, 1.0), (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
    x, v, held = states.x[0].copy(), states.v[0].copy(), states.held[0]
    stage, rates, total = x.copy(), np.zeros_like(x), np.zeros(x.size)
    all_x, all_stage, all_rates = x.ravel(), stage.ravel(), rates.ravel()  # the same numbers, in a row
    p_ref, drawn, p_e = np.empty(n_machine), np.empty(n_load), np.empty(n_machine)
    source, p_ref_ends, drawn_ends = np.empty(len(v)), np.empty((2, n_machine)), np.empty((2, n_load))
    for k in range(n):
        if k == n - 1:  # the next piece does this point once more
            load = LoadSlopes(carried.load.slopes.copy(), carried.load.answer.copy())
            carried = CarriedVoltages(carried.recent.copy(), load, carried.age.copy())
        if k >= agc.first and (k - agc.first) % agc.period == 0 and k < n - 1:
            held = -agc.gain * mean_angle(data, x)
        states.held[k] = held
        _set_inputs(inputs, k, p_ref_ends, drawn_ends)
        for j in range(steps):
            carried.age[0] += 1
            for s in range(4):
                inside = (j + node[s]) / steps
                for i in range(len(total)):
                    all_stage[i] = all_x[i] + h * node[s] * all_rates[i]
                for i in range(n_machine):
                    p_ref[i] = p_ref_ends[0, i] + inside * (p_ref_ends[1, i] - p_ref_ends[0, i])
                    p_ref[i] += agc.participation[i] * held
                for i in range(n_load):
                    drawn[i] = drawn_ends[0, i] + inside * (drawn_ends[1, i] - drawn_ends[0, i])
                sources(data, stage, source)
                if not _next_voltages(network, drawn, source, carried, s, v):
                    return k
                machine_rates(data, stage, v, p_ref, inputs.v_ref, rates, p_e)
                if s == 0 and j == 0:
                    copy_row(all_x, states.x[k].ravel())
                    copy_row(v, states.v[k])
                    copy_row(p_e, states.p_e[k])
                    for g, i in enumerate(inputs.machine):
                        gate, turbine = data.reheat[i] * x[GATE, i], (1.0 - data.reheat[i]) * x[TURBINE, i]
                        states.omega[k, g], states.p_gen[k, g] = x[SPEED, i] * data.omega_0[i], gate + turbine
                    if k == n - 1:
                        return n
                for i in range(len(total)):
                    total[i] += h * weight[s] * all_rates[i]
            for i in range(len(total)):
                all_x[i] += total[i]
                total[i] = 0.0
    return n
