"""The detailed plant: ANDES's traces, rest, balance, order, an independent solver, AGC, starts, refusals."""

from __future__ import annotations

import dataclasses
import json
from itertools import pairwise

import numpy as np
import pytest
from sksundae.ida import IDA

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.detailed_plant import DetailedPlant
from ded_bench.plants.detailed.machine_arrays import DELTA, E1Q, GATE, N_STATES, SPEED, WASHOUT
from ded_bench.plants.plant import SimulationError, plant_of, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from tests.detailed_cases import GRIDS, MIXED, VARIANTS, andes_trace, detailed_case


@pytest.fixture(scope="module")
def mixed() -> Case:
    return Case.load(MIXED)


@pytest.fixture(scope="module")
def plant(mixed) -> DetailedPlant:
    return DetailedPlant(mixed)


def ramping(case, quiet_instance, **changes):
    """An instance of 8 s with ramps of all loads, and a schedule that bends four times."""
    rates = 0.01 * np.resize([1.0, -1.0], len(case.loads)) * case.load_nominal
    load = {
        bus: {"initial": value, "start": 0.5 + i, "duration": 3.0, "rate": rate}
        for i, (bus, value, rate) in enumerate(
            zip(case.loads, case.load_nominal.tolist(), rates, strict=True)
        )
    }
    instance = quiet_instance(case, horizon_s=8.0, load=load, **changes)
    p = np.random.default_rng(1).uniform(-0.05, 0.05, (5, len(case.generators))) + case.p_nominal
    p[0] = instance.p_initial(case)
    return instance, Schedule(np.linspace(0.0, 8.0, 5), p)


# Against others.


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("grid", GRIDS)
def test_andes_says_the_same(grid, variant, tmp_path, quiet_instance):
    """Frequencies to 2e-6 Hz (140bus: 1e-5 Hz, whose trace no other solver confirmed), powers 1e-5 pu.

    The trapezoidal rule of the traces leaves up to 1e-6 pu of voltage.
    """
    trace = andes_trace(grid, variant, tmp_path, quiet_instance)
    run = simulate(trace.case, trace.instance, trace.schedule)
    limit = 2 * np.pi * (1e-5 if grid == "140bus" else 2e-6)
    np.testing.assert_allclose(run.omega[::25], trace.omega, rtol=0, atol=limit)
    np.testing.assert_allclose(run.p_gen[::25], trace.p_gen, rtol=0, atol=1e-5)
    for bus, voltage in trace.voltage.items():
        np.testing.assert_allclose(run.columns[f"v_{bus}"][::25], voltage, rtol=0, atol=2e-6)


def test_ida_says_the_same(mixed, plant, quiet_instance):
    """SUNDIALS IDA on the symbolic DAE, restarted at every kink and every time of secondary control.

    Frequencies to 1e-7 Hz: Kutta's method has an error of that order with steps of 0.01 s.
    """
    instance, schedule = ramping(mixed, quiet_instance)
    run = simulate(mixed, instance, schedule, plant)
    system, agc, start = plant.system, mixed.agc, plant.initial(instance)
    n, n_x = len(system.data), start.x.size
    differential = system.moving
    still = np.setdiff1d(np.arange(n_x), differential)
    kinks = {0.0, 8.0, *schedule.t, *(t for load in instance.load.values() for t in load.kinks)}
    stops = np.unique(np.round([*kinks, *np.arange(0.0, 8.0, agc.period_s)], 9))
    y, held = np.concatenate([start.x.ravel(), start.v]), 0.0

    def inputs(t):
        p_ref = start.offset + held * system.shares
        p_ref[system.scheduled] += schedule.at(np.array([t]))[0]
        return p_ref, system.p_drawn(instance.p_load(mixed, np.array([t])))[0], start.v_ref

    def residual(t, y, yp, res):
        rates, balance, *_ = system.symbolic.equations(y[:n_x], y[n_x:], *inputs(t))
        res[:n_x] = rates.full().ravel() - yp[:n_x]
        res[still] = yp[still]
        res[n_x:] = balance.full().ravel()

    def jacobian(t, y, yp, res, cj, out):
        out[:] = system.symbolic.jacobian(y[:n_x], y[n_x:], *inputs(t)).full()[: len(y)]
        out[differential, differential] -= cj
        out[still] = cj * np.eye(len(y))[still]

    options = {"rtol": 1e-9, "atol": 1e-11, "max_num_steps": 100_000}
    solver = IDA(residual, jacfn=jacobian, algebraic_idx=np.arange(n_x, len(y)), **options)
    for first, last in pairwise(stops):
        if first > 0 and first % agc.period_s == 0:
            held = -agc.k * float(system.data.inertia @ y[DELTA * n : (DELTA + 1) * n])
        rates, *_ = system.symbolic.equations(y[:n_x], y[n_x:], *inputs(first))
        yp = np.concatenate([rates.full().ravel(), np.zeros(len(y) - n_x)])
        y = solver.solve(np.array([first, last]), y, yp).y[-1]
        k = round(last / instance.dt_s)
        speeds = y[SPEED * n : (SPEED + 1) * n] * system.data.omega_0
        np.testing.assert_allclose(run.omega[k], speeds[system.scheduled], rtol=0, atol=2 * np.pi * 1e-7)
        delivered = system.turbines(y[:n_x].reshape(N_STATES, n))[system.scheduled]
        np.testing.assert_allclose(run.p_gen[k], delivered, rtol=0, atol=1e-7)
    assert np.abs(run.omega).max() > 0.01


# By itself.


@pytest.mark.parametrize("slack", ["island", "infinite"])
@pytest.mark.parametrize("grid", GRIDS)
def test_it_rests_at_an_equilibrium(grid, slack, tmp_path, quiet_instance, constant):
    """For a minute, within 1e-9 Hz; also far from nominal powers."""
    case = detailed_case(grid, tmp_path, slack)
    instance = quiet_instance(case, horizon_s=60.0)
    run = simulate(case, instance, constant(instance, case.p_nominal))
    assert np.abs(run.omega).max() < 2 * np.pi * 1e-9
    np.testing.assert_allclose(run.p_gen, np.tile(run.p_gen[0], (len(run.t), 1)), rtol=0, atol=1e-9)


def test_powers_are_balanced(mixed, plant, quiet_instance):
    """At every time: electrical powers are loads and what lines and shunts take; swing powers the rest.

    Σ M dω/dt = Σ (P_m - P_e - d ω), with the derivative by differences over 0.02 s.
    """
    instance, schedule = ramping(mixed, quiet_instance)
    run = simulate(mixed, instance, schedule, plant)
    system, states = plant.system, run.states.states
    network, data = system.network, system.data
    v = states.v.view(np.complex128)
    lost = (v * (v @ network.admittance.T).conj()).real.sum(axis=1)
    drawn = system.p_drawn(run.p_load).sum(axis=1)
    np.testing.assert_allclose(states.p_e.sum(axis=1), drawn + lost, rtol=0, atol=1e-8)
    w = states.x[:, SPEED]
    swing = (w[2:] - w[:-2]) / (2 * instance.dt_s * data.inverse_m)
    left = (system.turbines(states.x) - states.p_e - data.d * w)[1:-1]
    smooth = np.abs(
        np.arange(2, 800)[:, None] * 0.01 - np.unique([*schedule.t, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5])
    )
    np.testing.assert_allclose(
        swing[1:][smooth.min(axis=1) > 0.5], left[1:][smooth.min(axis=1) > 0.5], atol=2e-4
    )


def test_the_integrator_is_of_order_four(plant, mixed, quiet_instance):
    """Twice the steps, a sixteenth of the error; set-points and loads bend at common points of all grids."""
    instance, schedule = ramping(mixed, quiet_instance)
    ends = []
    for dt_s in (0.01, 0.005, 0.00125):
        t = np.arange(round(8.0 / dt_s) + 1) * dt_s
        grid = np.arange(round(8.0 / 0.01) + 1) * 0.01
        p_set = np.column_stack([np.interp(t, grid, column) for column in schedule.at(grid).T])
        p_load = np.column_stack([np.interp(t, grid, column) for column in instance.p_load(mixed, grid).T])
        quick = dataclasses.replace(plant)
        quick.system.__dict__["fastest"] = 0.0  # one step from point to point
        piece = quick.advance(quick.initial(instance), p_set, p_load, dt_s)
        ends.append(piece.omega[:: round(0.01 / dt_s)])
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.2)


def test_in_pieces_it_does_what_it_does_at_once(mixed, plant, quiet_instance):
    """To the last bit, also where a piece begins or ends at a time of secondary control, which acts once."""
    instance, schedule = ramping(mixed, quiet_instance)
    whole, p_load = simulate(mixed, instance, schedule, plant), instance.p_load(mixed)
    state = plant.initial(instance)
    for first, last in ((0, 1), (1, 137), (137, 137), (137, 200), (200, 399), (399, 600), (600, 800)):
        k = slice(first, last + 1)
        piece = plant.advance(state, whole.p_set[k], p_load[k], instance.dt_s)
        state = piece.end
        for name in ("omega", "p_gen"):
            np.testing.assert_array_equal(getattr(piece, name), getattr(whole, name)[k])
    agc = whole.columns["agc"]
    assert np.flatnonzero(np.diff(agc)).tolist() == [199, 399, 599]
    assert agc[-1] == pytest.approx(state.held, rel=1e-9)
    assert state.held != 0.0


def test_what_is_observed_at_rest_leads_to_the_same_state(mixed, plant, quiet_instance, alter):
    instance = quiet_instance(mixed, horizon_s=8.0)
    state = plant.initial(instance)
    seen = json.loads(plant.observed(state).initial(mixed).model_dump_json())
    again = alter(instance, schema="ded-bench/instance/2", initial=seen)
    for mine, other in zip(plant.initial(again)[:-1], state[:-1], strict=True):  # nothing is carried yet
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-9)


def test_a_measured_start_has_what_was_measured(mixed, plant, quiet_instance, alter):
    """Angles, frequencies, powers of turbines; fluxes and exciters are stationary, so that nothing jumps."""
    instance, schedule = ramping(mixed, quiet_instance)
    whole, k = simulate(mixed, instance, schedule, plant), 330
    state = plant.advance(
        plant.initial(instance), whole.p_set[: k + 1], whole.p_load[: k + 1], instance.dt_s
    ).end
    seen = plant.observed(state)
    load = {
        bus: {"initial": value, "start": 0.0, "duration": 0.0, "rate": 0.0}
        for bus, value in zip(mixed.loads, whole.p_load[k].tolist(), strict=True)
    }
    initial = json.loads(seen.initial(mixed).model_dump_json())
    second = alter(instance, schema="ded-bench/instance/2", load=load, initial=initial)
    start = plant.initial(second)
    for name in ("theta", "omega", "p_gen", "mechanical"):
        np.testing.assert_allclose(getattr(plant.observed(start), name), getattr(seen, name), atol=1e-12)
    assert start.next_s == pytest.approx(0.7)
    x, data = start.x.copy(), plant.system.data
    drawn, reference = (plant.system.p_drawn(whole.p_load[[k]])[0], seen.agc.held_pu * plant.system.shares)
    reference[plant.system.scheduled] += seen.p_gen
    np.testing.assert_allclose(x[GATE], reference - data.droop * x[SPEED], rtol=0, atol=1e-12)
    assert data.inertia @ x[DELTA] == pytest.approx(seen.agc.integral_rad, rel=1e-9)
    x[DELTA] -= data.inertia @ x[DELTA]
    x[SPEED] = x[WASHOUT] = 0.0
    given = x.ravel(), start.v, reference, drawn, start.v_ref
    rates, balance, *_ = plant.system.symbolic.equations(*given)
    assert np.abs(balance.full()).max() < 1e-8
    assert np.abs(rates.full().reshape(N_STATES, -1)[E1Q : WASHOUT + 1]).max() < 1e-8


def test_a_remainder_is_the_slack_machines(mixed, plant, quiet_instance, alter):
    """Up to 1e-4 pu, as an offset of its reference; more is an error that says so."""
    instance = quiet_instance(mixed)
    power = dict(instance.initial.power)
    for more, fits in ((0.9e-4, True), (1.2e-4, False)):
        power["east"] = instance.initial.power["east"] + more
        start = {"power": power, "omega": dict(instance.initial.omega)}
        changed = alter(instance, initial=start)
        if fits:
            offset = plant.initial(changed).offset
            assert offset[list(mixed.detailed.machines).index("south")] == pytest.approx(-more, rel=0.05)
            plant.check_servable(changed, "my.json")
        else:
            with pytest.raises(InputError, match=r"initial\.power: initial loads and losses exceed power by"):
                plant.initial(changed)
            with pytest.raises(InputError, match=r"^my\.json: initial\.power"):
                plant.check_servable(changed, "my.json")


def test_voltages_that_collapse_end_the_simulation(mixed, plant, quiet_instance, constant):
    load = {bus: {"initial": v, "start": 0.0, "duration": 8.0, "rate": v} for bus, v in
            zip(mixed.loads, mixed.load_nominal.tolist(), strict=True)}  # fmt: skip
    instance = quiet_instance(mixed, horizon_s=8.0, load=load)
    with pytest.raises(SimulationError, match="the network has no voltages any more"):
        simulate(mixed, instance, constant(instance, mixed.p_nominal), plant)


def test_secondary_control_between_points_is_refused(mixed, plant, quiet_instance, constant):
    instance = quiet_instance(mixed, horizon_s=3.0, dt_s=0.03)
    with pytest.raises(InputError, match=r"dt_s: AGC acts at . s, between points of time"):
        simulate(mixed, instance, constant(instance, mixed.p_nominal), plant)


def test_behind_an_infinite_slack_angles_are_not_told(quiet_instance, constant, alter):
    """A planner starts from its own equilibrium, and angles of another plant are refused."""
    case = Case.load("two-area")
    plant, instance = plant_of(case, "detailed"), quiet_instance(case, horizon_s=1.0)
    seen = plant.observed(plant.initial(instance)).initial(case)
    assert seen == instance.initial
    angles = json.loads(seen.model_dump_json()) | {"theta": dict.fromkeys(case.generators, 0.1)}
    told = alter(instance, schema="ded-bench/instance/2", initial=angles)
    with pytest.raises(InputError, match=r"initial\.theta: angles behind an infinite slack"):
        plant.initial(told)


def test_a_lossless_case_is_judged_on_its_machines(quiet_instance, constant):
    """Generators are the machines of their names; the slack's machine stands still and takes the losses."""
    case = Case.load("two-area")
    plant = plant_of(case, "detailed")
    instance = quiet_instance(case, horizon_s=1.0)
    run = simulate(case, instance, constant(instance, case.p_nominal), plant)
    system = plant.system
    assert system.network.balancing == list(case.detailed.machines).index(case.machine_of(case.slack))
    assert run.p_slack == pytest.approx(system.network.nominal().power.real[system.network.balancing])
    assert not system.island
