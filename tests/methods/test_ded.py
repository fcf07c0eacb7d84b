"""Full DED: known optima, order of accuracy, reuse of one model, honest statuses."""

from __future__ import annotations

import numpy as np
import pyomo.environ as pyo
import pytest

from ded_bench.methods.ded import build_ded, prepare, schedule_of, set_instance
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import SimulationError, simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, LoadRamp
from ded_bench.problem.sampling import sample_instance
from ded_bench.solvers.ipopt import CasadiIpopt
from ded_bench.solvers.status import Status

HORIZON = 1.0
ACCELERATED = Settings("accelerated=on")


def short(case: Case, index: int, **changes) -> Instance:
    return sample_instance(case, 77, index).model_copy(update={"horizon_s": HORIZON, **changes})


def test_reused_model_gives_the_objective_of_a_fresh_one(case: Case) -> None:
    instances = [short(case, i) for i in range(2)]
    solve = prepare(case, "TO", Settings())
    solve(instances[1])
    for instance in instances:
        again = solve(instance)
        model = build_ded(case, instance.steps, instance.dt_s)
        set_instance(model, case, instance, "TO")
        fresh = CasadiIpopt(model).solve()
        assert again.status == fresh.status == Status.OPTIMAL
        assert again.solver_objective == pytest.approx(fresh.objective, rel=1e-9)


def test_an_instance_that_cannot_begin_leaves_no_other_model_behind(threebus: Case) -> None:
    """Its steps are others, so that a model is built for it; the next answer is read from the one solved."""
    solve, (one, other) = prepare(threebus, "TO", Settings()), (short(threebus, i) for i in range(2))
    alone = solve(other).solver_objective
    solve(one)
    loads = {bus: LoadRamp(initial=-100.0, start=0.0, duration=0.0, rate=0.0) for bus in threebus.loads}
    with pytest.raises(SimulationError):
        solve(short(threebus, 1, horizon_s=2 * HORIZON, load=loads))
    assert solve(other).solver_objective == pytest.approx(alone, rel=1e-9)


def test_solved_schedule_is_feasible_on_the_true_system(case: Case) -> None:
    for regime in case.regimes:
        instance = short(case, 3)
        solution = prepare(case, regime, Settings())(instance)
        verdict = score(case, instance, solution.schedule, regime)
        assert solution.status == Status.OPTIMAL
        assert solution.iterations > 0
        assert verdict.feasible
        assert verdict.ramp_violation <= 1.8e-9
        # Euler's error in cost is of first order in dt: well below a thousandth here.
        assert verdict.objective == pytest.approx(solution.solver_objective, rel=1e-3)


def test_where_nothing_may_move_the_optimum_is_the_static_one(case: Case, quiet_instance, alter) -> None:
    """Constant loads, started at their static dispatch, with a frequency bound near zero.

    (A loose bound pays: an optimum lets the frequency sag before the horizon ends.)
    """
    case = alter(case, regimes={"NO": {"omega_hz": 1e-7}})
    cost = dict(
        zip(
            (case.slack, *case.generators),
            np.linspace(0.9, 0.2, 1 + len(case.generators)).tolist(),
            strict=True,
        )
    )
    p_opt = merit_order(
        case, np.array([cost[g] for g in case.generators]), cost[case.slack], case.load_nominal
    )
    power = dict(zip(case.generators, p_opt.tolist(), strict=True))
    omega = dict.fromkeys(case.generators, 0.0)
    instance = quiet_instance(case, horizon_s=HORIZON, cost=cost, initial={"power": power, "omega": omega})
    solution = prepare(case, "NO", Settings())(instance)
    p_slack = -p_opt.sum() - case.load_nominal.sum()
    static = sum(cost[g] * power[g] for g in case.generators) + cost[case.slack] * abs(p_slack)
    assert solution.solver_objective == pytest.approx(static * (instance.steps + 1), rel=1e-4)
    # One step may use the whole bound: |ΔP| <= M 2 (2π 1e-7) / dt, below 1e-3 pu for these machines.
    np.testing.assert_allclose(solution.schedule.p, np.tile(p_opt, (instance.steps + 1, 1)), atol=1e-3)


def test_the_model_is_backward_euler_of_the_true_system(case: Case) -> None:
    """With the inputs fixed, the model's state nears the simulated one in first order of dt."""
    errors = []
    for dt in (0.02, 0.01):
        instance = short(case, 1, dt_s=dt)
        solution = prepare(case, "NO", Settings())(instance)
        model = build_ded(case, instance.steps, dt)
        set_instance(model, case, instance, "NO")
        moving = np.clip(0.02 * np.sin(instance.grid)[:, None], -0.02, 0.02) + instance.p_initial(case)
        for j, g in enumerate(case.generators):
            for t, value in zip(list(model.t), moving[:, j].tolist(), strict=True):
                model.p_gen[g, t].setlb(value)
                model.p_gen[g, t].setub(value)
                model.p_gen[g, t].set_value(value)
                model.omega[g, t].setlb(None if t else model.omega[g, t].lb)
                model.omega[g, t].setub(None if t else model.omega[g, t].ub)
        assert CasadiIpopt(model).solve().status == Status.OPTIMAL
        truth = simulate(case, instance, schedule_of(model, instance))
        omega = np.array([[pyo.value(model.omega[g, t]) for g in case.generators] for t in model.t])
        errors.append(np.abs(omega - truth.omega).max())
        assert solution.schedule.t[-1] == pytest.approx(HORIZON)
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_accelerated_finds_the_same_optimum(case: Case) -> None:
    """The same discretised problem, to 1e-6; then to what IPOPT relaxes bounds by, 1e-8 of a bound."""
    for index, regime in enumerate(case.regimes):
        instance = short(case, index)
        usual = prepare(case, regime, Settings())(instance)
        fast = prepare(case, regime, ACCELERATED)(instance)
        assert usual.status == fast.status == Status.OPTIMAL
        assert fast.solver_version.startswith("piqp")
        assert fast.solver_objective == pytest.approx(usual.solver_objective, rel=1e-6)
        verdict = score(case, instance, fast.schedule, regime)
        assert verdict.feasible
        assert verdict.ramp_violation < 1e-10
        plain = score(case, instance, usual.schedule, regime)
        assert verdict.objective == pytest.approx(plain.objective, rel=1e-6)


def test_what_a_sequence_cannot_solve_ipopt_decides(threebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    instance = short(threebus, 0)
    bad = instance.initial.model_copy(update={"power": {"plant": 0.95}})  # p_max is 0.9
    solve = prepare(threebus, "NO", ACCELERATED)
    solution = solve(instance.model_copy(update={"initial": bad}))
    assert solution.status == Status.INFEASIBLE
    assert solution.schedule is None
    assert "piqp" in solution.solver_version
    assert "ipopt" in solution.solver_version
    monkeypatch.setattr("ded_bench.methods.euler_program.TOLERANCE", 0.0)
    patient = solve(instance)
    assert patient.status == Status.OPTIMAL
    assert "ipopt" in patient.solver_version
    monkeypatch.undo()
    again = solve(instance)
    assert "ipopt" not in again.solver_version
    assert again.solver_objective == pytest.approx(patient.solver_objective, rel=1e-6)
    hasty = prepare(threebus, "NO", Settings("accelerated=on", time_limit_s=1e-9))(instance)
    assert hasty.status == Status.TIME_LIMIT
    assert hasty.error
