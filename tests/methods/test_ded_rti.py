"""Real-time iterations: soft limits, rows and linearisation from the plan in force, a margin in operation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.methods import ded_ko_knots
from ded_bench.methods.ded_rti import Options, RealTimeSolver
from ded_bench.methods.registry import get_method
from ded_bench.methods.reserve import AHEAD_S, LIMIT, Reserve
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.bench import timed
from ded_bench.solvers.status import Status
from ded_bench.surrogates.linear import nominal_model
from tests.methods.on_surrogates import replay, short
from tests.methods.test_ded_ko_knots import least_excess

#: Between rows |ω| may pass the bound by SOFT_TOLERANCE of it, which saves at most this part of the cost.
SAVED = 1e-3


def at_rest(case: Case, instance: Instance) -> Instance:
    """The same, with frequencies inside of any margin."""
    rest = instance.initial.model_copy(update={"omega": dict.fromkeys(case.generators, 0.0)})
    return instance.model_copy(update={"initial": rest})


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_soft_limits_do_not_change_the_optimum(case: Case, koopman, regime: str) -> None:
    """A lifted model is the same along every plan; where limits can hold, the penalty is exact."""
    for index in range(3):
        instance = at_rest(case, short(case, index))
        hard = ded_ko_knots.prepare_with(case, koopman, regime, Settings())(instance)
        soft = RealTimeSolver(case, koopman, regime, Options(0.25))(instance)
        assert (hard.status, soft.status) == (Status.OPTIMAL, Status.FEASIBLE)
        assert soft.solver_objective == pytest.approx(hard.solver_objective, rel=SAVED)


def test_plans_in_operation_keep_the_margin(case: Case, koopman) -> None:
    margin, instance = 0.25, at_rest(case, sample_instance(case, 77, 0))
    solver = RealTimeSolver(case, koopman, "TO", Options(margin))
    single, plan = solver(instance), solver.solve(instance)
    assert plan.status == Status.FEASIBLE
    assert plan.solver_objective >= single.solver_objective * (1 - SAVED)
    omega = np.abs(replay(case, koopman, instance, plan.schedule).omega[1:]).max()
    assert omega <= (1 - margin) * case.omega_bound("TO") * (1 + 1.1 * SOFT_TOLERANCE)


def test_what_is_infeasible_is_exceeded_little(ninebus: Case) -> None:
    """A start beyond the bound: the plan says so, and its total excess is nearly the least there is."""
    koopman = nominal_model(ninebus)
    bound, instance = ninebus.omega_bound("TO"), short(ninebus, 0)
    beyond = instance.initial.model_copy(update={"omega": dict.fromkeys(ninebus.generators, 1.2 * bound)})
    instance = instance.model_copy(update={"initial": beyond})
    plan = RealTimeSolver(ninebus, koopman, "TO", Options(0.0)).solve(instance)
    assert (plan.status, plan.solver_objective) == (Status.INFEASIBLE, None)
    first = np.rint(plan.schedule.t[:-1] / instance.dt_s).astype(int)
    over = np.abs(replay(ninebus, koopman, instance, plan.schedule).omega).max(axis=1) - bound
    total = np.maximum(np.maximum.reduceat(over[1:], first), 0.0).sum()
    assert total == pytest.approx(least_excess(ninebus, koopman, instance, "TO"), rel=0.02)


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


def answered(case: Case, instance: Instance, settings: str, regime: str, model: str) -> Schedule:
    solver = get_method("ded-rti").prepare(case, regime, Settings(settings, model=model))
    solution = solver(instance)
    assert solution.status == Status.FEASIBLE
    return solution.schedule


def shortage(reserve: Reserve, power: Array) -> float:
    """The least e with which every ramp can be followed from some powers, rad/s, one ramp after another."""
    case, worst = reserve.case, 0.0
    n = len(power)
    for alone in reserve.speeds:
        rows = np.block([[reserve.compliance, -np.ones((n, 1))], [-reserve.compliance, -np.ones((n, 1))]])
        room = [
            (max(-r, (low - p) / reserve.duration_s), min(r, (high - p) / reserve.duration_s))
            for r, p, low, high in zip(case.ramp, power, case.p_min, case.p_max, strict=True)
        ]
        found = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=rows,
            b_ub=np.concatenate([reserve.limit - alone, reserve.limit + alone]),
            bounds=[*room, (0.0, None)],
        )
        assert found.status == 0
        worst = max(worst, found.fun)
    return worst


def test_speeds_are_those_of_the_power_flow(case: Case) -> None:
    """A load that ramps slowly takes the angles from one equilibrium to the next."""
    reserve, network, tiny = Reserve.of(case, 0.0), Network(case), 1e-5
    n_loads = len(case.loads)
    assert reserve.speeds.shape == (2 * n_loads, len(case.generators))
    for i in range(n_loads):
        change = tiny * np.eye(n_loads)[i] * np.abs(case.load_rate[:, i]).max()
        ends = [
            network.power_flow(case.p_nominal, case.load_nominal + sign * change)[network.generators]
            for sign in (-0.5, 0.5)
        ]
        # What is left of the central difference is of second order, and the digits of the power flow.
        expected = (ends[1] - ends[0]) / tiny
        assert np.allclose(-reserve.speeds[i], expected, rtol=1e-5, atol=1e-6)
        assert np.array_equal(reserve.speeds[n_loads + i], -reserve.speeds[i])


@pytest.mark.parametrize("index", [0, 1])
def test_plans_keep_room_for_the_steepest_ramps(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where plans without reserve have generators at their limits; an independent solver says how short."""
    case = Case.load("two-area")
    instance = sample_instance(case, VALIDATION_SEED, index)
    reserve = Reserve.of(case, LIMIT * case.omega_bound("TO"))
    dear = dataclasses.replace(reserve, price=20.0)  # above all that room can cost
    monkeypatch.setattr(Reserve, "of", lambda *_: dear)
    assert len(reserve.speeds) == 4  # both loads, up and down
    worst = {}
    for settings in ("default", "reserve=on"):
        schedule = answered(case, instance, settings, "TO", "trajectory")
        # The first seconds lead from P_0 to where there is room.
        chosen = (schedule.t > 10.0) & (schedule.t < AHEAD_S)
        worst[settings] = max(shortage(reserve, power) for power in schedule.p[chosen])
    assert worst["default"] > 0.1 * reserve.limit
    # Programs stop at residuals of 1e-5, in rad/s and pu.
    assert worst["reserve=on"] < 1e-3 * reserve.limit


def test_where_no_ramp_is_fast_plans_are_the_same(ninebus: Case) -> None:
    assert len(Reserve.of(ninebus, LIMIT * ninebus.omega_bound("NO")).speeds) == 0
    instance = sample_instance(ninebus, VALIDATION_SEED, 0)
    plain, with_reserve = (
        answered(ninebus, instance, settings, "NO", "linear") for settings in ("default", "reserve=on")
    )
    assert np.array_equal(plain.p, with_reserve.p)
