"""Real-time iterations: soft limits, rows and linearisation from the plan in force, margins and room."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.methods import ded_ko_knots, surprises
from ded_bench.methods.ded_rti import NEAR_S, Options, RealTimeSolver
from ded_bench.methods.ed import static_dispatch
from ded_bench.methods.knot_program import KnotProgram, Plan
from ded_bench.methods.knots import case_knots
from ded_bench.methods.registry import get_method
from ded_bench.methods.reserve import steady_speeds, sudden_speeds
from ded_bench.methods.slp import MAX_SOFT_PROGRAMS
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surprises import AHEAD_S, ALWAYS, LASTS_S, LIMIT, Surprises
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE, solve_on_surrogate
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.bench import timed
from ded_bench.solvers.linear_program import FormAnswer
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import TRAJECTORY, find_surrogate
from ded_bench.surrogates.linear import linear_model
from tests.methods.on_surrogates import prepared, replay, short
from tests.methods.policies import short_instances
from tests.methods.test_ded_ko_knots import least_excess

#: Between rows |ω| may pass the bound by SOFT_TOLERANCE of it, which saves at most this part of the cost.
SAVED = 1e-3


def at_rest(case: Case, instance: Instance) -> Instance:
    """The same, with frequencies inside of any margin."""
    rest = instance.initial.model_copy(update={"omega": dict.fromkeys(case.generators, 0.0)})
    return instance.model_copy(update={"initial": rest})


def steady(case: Case, instance: Instance) -> Instance:
    """The same at rest, with nominal loads that stay."""
    last, nominal = instance.horizon_s, zip(case.loads, case.load_nominal.tolist(), strict=True)
    load = {bus: LoadPoints(points=((0.0, p), (last, p))) for bus, p in nominal}
    return at_rest(case, instance).model_copy(update={"load": load})


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_soft_limits_do_not_change_the_optimum(case: Case, koopman, regime: str) -> None:
    """A lifted model is the same along every plan; where limits can hold, the penalty is exact."""
    for index in range(3):
        instance = at_rest(case, short(case, index))
        hard = prepared(ded_ko_knots, case, koopman, regime)(instance)
        soft = RealTimeSolver(case, koopman, regime)(instance)
        assert (hard.status, soft.status) == (Status.OPTIMAL, Status.FEASIBLE)
        assert soft.solver_objective == pytest.approx(hard.solver_objective, rel=SAVED)


@pytest.mark.parametrize("asked", [None, 0.6])
def test_plans_in_operation_keep_the_margin(case: Case, koopman, asked: float | None) -> None:
    instance = steady(case, sample_instance(case, 77, 0))
    plan = RealTimeSolver(case, koopman, "TO", Options(margin=asked)).solve(instance)
    assert plan.status == Status.FEASIBLE
    omega = replay(case, koopman, instance, plan.schedule).omega[1 : round(NEAR_S / instance.dt_s)]
    kept = (1 - (asked or ALWAYS)) * case.omega_bound("TO") * (1 + 1.1 * SOFT_TOLERANCE)
    assert np.abs(omega).max() <= kept


def test_a_horizon_shorter_than_the_plans_own_is_planned_to_its_end(threebus: Case) -> None:
    instance = short_instances(threebus, 1, horizon=6.0)[0]
    planner = get_method("ded-rti").prepare(threebus, "TO", Settings(model="trajectory"))
    plan = planner.solve(instance).schedule
    assert plan.t[-1] == 6.0
    assert (np.diff(plan.t) > 0).all()


def test_what_is_infeasible_is_exceeded_little(ninebus: Case) -> None:
    """A start beyond the bound: in operation a plan says so; its total excess is nearly the least."""
    koopman = linear_model(ninebus)
    bound, instance = ninebus.omega_bound("TO"), short(ninebus, 0)
    beyond = instance.initial.model_copy(update={"omega": dict.fromkeys(ninebus.generators, 1.2 * bound)})
    instance = instance.model_copy(update={"initial": beyond})
    assert RealTimeSolver(ninebus, koopman, "TO").solve(instance).status == Status.INFEASIBLE
    plan = RealTimeSolver(ninebus, koopman, "TO")(instance)
    assert (plan.status, plan.solver_objective, plan.error) == (Status.FEASIBLE, None, "")
    first = np.rint(plan.schedule.t[:-1] / instance.dt_s).astype(int)
    over = np.abs(replay(ninebus, koopman, instance, plan.schedule).omega).max(axis=1) - bound
    total = np.maximum(np.maximum.reduceat(over[1:], first), 0.0).sum()
    assert total == pytest.approx(least_excess(ninebus, koopman, instance, "TO"), rel=0.02)


def test_what_is_paid_for_asks_for_no_further_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start beyond a bound that is tighter for a while, which ends between two knots."""
    case, left = Case.load("two-area"), []
    bounds, instance = case.bounds("TO"), sample_instance(case, VALIDATION_SEED, 0)
    fast = dict.fromkeys(case.generators, 1.1 * case.omega_bound("TO"))
    beyond = instance.initial.model_copy(update={"omega": fast})
    instance = instance.model_copy(update={"initial": beyond})
    solve_relaxed = KnotProgram.solve_relaxed

    def counted(program: KnotProgram, *args: Any) -> tuple[FormAnswer, Array]:
        answer, widened = solve_relaxed(program, *args)
        left.append(program.excess(program.predict(answer.x).outputs, widened))
        assert widened[0] > 0.1 * bounds.limit.min()
        return answer, widened

    monkeypatch.setattr(KnotProgram, "solve_relaxed", counted)
    margin = np.where(instance.grid < 0.8, 0.5, 0.0) * bounds.limit.min()
    knots, plan = case_knots(case, instance), Plan(static_dispatch(case, instance), margin=margin)
    surrogate = find_surrogate(case, TRAJECTORY, ())
    found = solve_on_surrogate(case, surrogate, instance, bounds, knots, plan=plan)
    assert found.status == Status.INFEASIBLE
    assert len(left) < MAX_SOFT_PROGRAMS
    assert left[-1] <= SOFT_TOLERANCE * bounds.limit.min()


def test_the_plan_in_force_saves_programs_and_model_error() -> None:
    """On two-area, where plans swing far from the static dispatch: fewer iterations, and a smaller excess."""
    case = Case.load("two-area")
    instance, settings = sample_instance(case, VALIDATION_SEED, 0), Settings()
    solver = get_method("ded-rti").prepare(case, "TO", settings)
    cold = solver.solve(at_rest(case, instance))
    warm = solver.solve(at_rest(case, instance), Solution(Status.FEASIBLE, cold.schedule))
    assert warm.iterations < 0.7 * cold.iterations
    usual = ded_ko_knots.prepare(case, "TO", Settings(model="trajectory"))(instance)
    excess = [score(case, instance, plan.schedule, "TO") for plan in (usual, solver(instance))]
    assert excess[1].freq_violation_hz < 0.2 * excess[0].freq_violation_hz


def test_build_and_solution_times_are_those_of_one_step(ninebus: Case) -> None:
    """So that `bench` times what operation asks for; the step before is set-up."""
    solver = get_method("ded-rti").prepare(ninebus, "TO", Settings(model="linear"))
    call = timed(solver, sample_instance(ninebus, 77, 2))
    parts = call["build_s"], call["setup_s"], call["solve_s"]
    assert min(parts) > 0
    assert sum(parts) == pytest.approx(call["call_s"], rel=0.2)


def test_speeds_are_those_of_the_power_flow(case: Case) -> None:
    """A load that ramps slowly takes the angles from one equilibrium to the next."""
    speeds, _ = steady_speeds(case)
    network, tiny = Network(case), 1e-5
    assert speeds.shape == (len(case.loads), len(case.generators))
    for one, change in zip(speeds, tiny * np.eye(len(case.loads)), strict=True):
        ends = [
            network.power_flow(case.p_nominal, case.load_nominal + sign * change)[network.generators]
            for sign in (-0.5, 0.5)
        ]
        # What is left of the central difference is of second order, and the digits of the power flow.
        assert np.allclose(one, (ends[1] - ends[0]) / tiny, rtol=1e-5, atol=1e-6)


def test_machines_swing_under_a_sudden_ramp_as_they_do_on_the_plant(case: Case) -> None:
    """From the nominal point at rest, a ramp of one load that no generator follows."""
    instance, t = steady(case, sample_instance(case, 77, 0)), np.arange(0.0, 3.01, 0.05)
    largest, rate = sudden_speeds(case, t), 1e-4
    power = dict(zip(case.generators, case.p_nominal.tolist(), strict=True))
    initial = instance.initial.model_copy(update={"power": power})
    stay = Schedule(np.array([0.0, instance.horizon_s]), np.tile(case.p_nominal, (2, 1)))
    for number, bus in enumerate(case.loads):
        start = float(case.load_nominal[number])
        ramp = LoadPoints(points=((0.0, start), (instance.horizon_s, start + rate * instance.horizon_s)))
        given = instance.model_copy(update={"initial": initial, "load": instance.load | {bus: ramp}})
        found = simulate(case, given, stay)
        near = found.t <= 3.0
        omega = np.maximum.accumulate(np.abs(found.omega[near]))
        expected = rate * np.transpose([np.interp(found.t[near], t, one) for one in largest[:, number].T])
        # Between points 0.05 s apart a swing of 1.5 Hz is linear to 3 % of its size.
        assert np.allclose(omega, expected, rtol=0.02, atol=0.03 * expected.max())


def test_machines_that_are_slow_need_less_margin_and_no_room(
    ninebus: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked ten times a second, plans on 9bus come before a ramp moves a machine by a tenth of the bound."""
    instance, t = steady(ninebus, sample_instance(ninebus, 77, 0)), np.arange(1.0, 15.0)
    known = Surprises(ninebus, bound := ninebus.omega_bound("TO"))
    known.expected(instance, None)
    assert known.margin(t).min() >= surprises.ALWAYS * bound
    assert known.room(t) is not None
    monkeypatch.setattr(known, "_between_s", 0.1)
    assert known.margin(t).max() < 0.1 * bound
    assert known.room(t) is None


def shortage(case: Case, power: Array) -> float:
    """The least e with which the steepest ramp of the first load, up or down, can be followed, rad/s."""
    by_load, compliance = steady_speeds(case)
    limit, steepest, n = LIMIT * case.omega_bound("TO"), np.abs(case.load_rate[:, 0]).max(), len(power)
    rows = np.block([[compliance, -np.ones((n, 1))], [-compliance, -np.ones((n, 1))]])
    worst = 0.0
    for alone in (steepest * by_load[0], -steepest * by_load[0]):
        room = [
            (max(-r, (low - p) / LASTS_S), min(r, (high - p) / LASTS_S))
            for r, p, low, high in zip(case.ramp, power, case.p_min, case.p_max, strict=True)
        ]
        found = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=rows,
            b_ub=np.concatenate([limit - alone, limit + alone]),
            bounds=[*room, (0.0, None)],
        )
        assert found.status == 0
        worst = max(worst, found.fun)
    return worst


@pytest.mark.parametrize("index", [0, 1])
def test_plans_keep_room_for_the_steepest_ramps(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where plans without room have generators at their limits; an independent solver says how short."""
    case = Case.load("two-area")
    monkeypatch.setattr(surprises, "PRICE", 20.0)  # above all that room can cost
    instance, worst = steady(case, sample_instance(case, VALIDATION_SEED, index)), {}
    for room in ("kept", "not kept"):
        if room == "not kept":
            monkeypatch.setattr(Surprises, "room", lambda *_: None)
        schedule = get_method("ded-rti").prepare(case, "TO", Settings()).solve(instance).schedule
        # The first seconds lead from P_0 to where there is room.
        chosen = (schedule.t > 10.0) & (schedule.t < AHEAD_S)
        assert chosen.any()
        worst[room] = max(shortage(case, power) for power in schedule.p[chosen])
    assert worst["not kept"] > 0.1 * case.omega_bound("TO")
    # Programs stop at residuals of 1e-5, in rad/s and pu.
    assert worst["kept"] < 1e-3 * case.omega_bound("TO")
