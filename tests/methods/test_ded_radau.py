"""DED by collocation: points and weights, kinks, order of accuracy, limits on the true system."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from ded_bench.methods.ded_radau import LONGEST_S, default_element, element_count, element_ends, prepare
from ded_bench.methods.radau_program import POINTS, WEIGHTS, RadauProgram
from ded_bench.methods.solution import Settings
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.ipopt import run_ipopt
from ded_bench.solvers.status import Status
from tests.detailed_cases import detailed_case

HORIZON = 2.0


def short(case: Case, index: int, **changes) -> Instance:
    return sample_instance(case, 77, index).model_copy(update={"horizon_s": HORIZON, **changes})


def ramping(case: Case, quiet_instance, start: float = 0.5, duration: float = 0.8, **changes) -> Instance:
    """Every load rises by 0.05 pu/s for a while, inside of `HORIZON`."""
    load = {
        bus: {"initial": nominal, "start": start, "duration": duration, "rate": -0.05}
        for bus, nominal in zip(case.loads, case.load_nominal.tolist(), strict=True)
    }
    return quiet_instance(case, **{"horizon_s": HORIZON, "load": load} | changes)


def test_points_and_weights_are_radaus() -> None:
    """They integrate polynomials up to degree 4 exactly, and none above: with c = 1 only Radau's do."""
    for degree in range(5):
        assert np.dot(WEIGHTS, np.power(POINTS, degree)) == pytest.approx(1 / (degree + 1), abs=1e-15)
    assert np.dot(WEIGHTS, np.power(POINTS, 5)) != pytest.approx(1 / 6, abs=1e-4)


def test_elements_end_where_loads_kink(ninebus: Case) -> None:
    for index in range(20):
        instance = sample_instance(ninebus, 77, index)
        count = element_count(ninebus, instance, 0.25)
        assert count == 240
        ends = element_ends(instance, count)
        assert ends.shape == (count + 1,)
        assert (ends[0], ends[-1]) == (0, 6000)
        assert (np.diff(ends) >= 1).all()
        for ramp in instance.load.values():
            for kink in (ramp.start, ramp.start + ramp.duration):
                if ramp.rate and kink < 60.0:
                    assert np.abs(ends * 0.01 - kink).min() <= 0.005 + 1e-9
        assert np.diff(ends).max() <= 27  # 25 on average; an element less in each of seven pieces


def test_elements_are_never_finer_than_the_grid_nor_fewer_than_the_kinks(
    threebus: Case, quiet_instance
) -> None:
    instance = ramping(threebus, quiet_instance)
    assert element_count(threebus, instance, 1e-3) == instance.steps
    assert element_ends(instance, instance.steps).tolist() == list(range(instance.steps + 1))
    assert element_count(threebus, instance, 100.0) == 3
    assert element_ends(instance, 3).tolist() == [0, 50, 130, 200]
    still = quiet_instance(threebus, horizon_s=HORIZON)
    assert element_ends(still, 4).tolist() == [0, 50, 100, 150, 200]


def test_fast_modes_ask_for_short_elements(ninebus: Case) -> None:
    """An eighth of the period of the fastest mode: docs/grids.md has their frequencies."""
    assert default_element(ninebus) == 0.1
    assert default_element(Case.load("39bus")) == pytest.approx(0.125 / 1.57, rel=5e-3)


def test_modes_that_do_not_swing_ask_for_nothing(threebus: Case, alter) -> None:
    machine = threebus.machines["plant"].model_copy(update={"d": 1e3})
    overdamped = alter(threebus, machines={"plant": machine.model_dump(mode="json")})
    assert default_element(overdamped) == LONGEST_S


def test_states_near_the_true_ones_in_high_order(case: Case, quiet_instance) -> None:
    """Inputs and loads are linear in every element, kinks lie at ends: order 4 or more, Euler's is 1."""
    instance = ramping(case, quiet_instance)
    bend = np.array([0.0, 0.5, 1.3, HORIZON])
    power = case.p_nominal + np.outer([0.0, 0.02, -0.01, 0.02], np.ones(len(case.generators)))
    schedule = Schedule(t=bend, p=power)
    truth = simulate(case, instance, schedule)
    network = Network(case)
    modes = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
    period = 2 * np.pi / np.abs(modes).max()
    coarsest = max(3, 3 * round(2 * HORIZON / period))  # six elements a period of the fastest mode
    errors, gaps = [], []
    for elements in (coarsest, 2 * coarsest, 4 * coarsest):
        ends = element_ends(instance, elements)
        program = RadauProgram(case, elements)
        arguments = program.arguments(instance, "NO", ends)
        lower, upper = arguments["lbx"], arguments["ubx"]
        lower[program.p_gen] = upper[program.p_gen] = schedule.at(instance.grid[ends])
        lower[program.omega], upper[program.omega] = -np.inf, np.inf
        outcome, x = run_ipopt(program.solver, arguments, 0.0)
        assert outcome.status == Status.OPTIMAL
        errors.append(np.abs(x[program.omega[:, -1]] - truth.omega[ends[1:]]).max())
        cost = truth.p_gen @ instance.cost_gen(case)
        cost = cost + instance.cost_slack(case) * np.abs(truth.p_slack)
        gaps.append(abs(outcome.objective / cost.sum() - 1))
    assert errors[0] < 1e-4
    assert errors[0] / errors[1] > 2**4
    assert errors[2] < 1e-7
    # The sum over the grid is not quite the integral: dt²/12 of the slope's change, and no more.
    assert gaps[-1] < 1e-6


def test_derivatives_of_all_elements_are_casadis(case: Case) -> None:
    """Put together from one element's, they are what CasADi finds by differentiating the whole."""
    instance = short(case, 0)
    ends = element_ends(instance, 20)
    program = RadauProgram(case, len(ends) - 1)
    given = program.arguments(instance, "TO", ends)
    rng = np.random.default_rng(0)
    at, weights = given["x0"] + rng.normal(0, 0.1, given["x0"].shape), rng.normal(size=given["lbg"].shape)
    rows, slopes, curvature = (
        program.solver.get_function(name) for name in ("nlp_g", "nlp_jac_g", "nlp_hess_l")
    )
    x = casadi.MX.sym("x", len(at))
    g = rows(x, given["p"])
    whole = casadi.Function(
        "whole", [x], [casadi.jacobian(g, x), casadi.hessian(casadi.dot(weights, g), x)[0]]
    )
    jacobian, hessian = (matrix.full() for matrix in whole(at))
    np.testing.assert_allclose(slopes(at, given["p"])[1].full(), jacobian, rtol=1e-12, atol=1e-12)
    found = curvature(at, given["p"], 1.0, weights).full()
    np.testing.assert_allclose(found, np.triu(hessian), rtol=1e-12, atol=1e-11)
    assert np.abs(hessian).max() > 0.1


def test_limits_hold_on_the_true_system(case: Case) -> None:
    for regime, index in (("NO", 3), ("TO", 0)):
        instance = short(case, index)
        solution = prepare(case, regime, Settings())(instance)
        assert solution.status == Status.OPTIMAL
        verdict = score(case, instance, solution.schedule, regime)
        assert verdict.freq_violation_hz < 1e-6
        # Per step of the grid: IPOPT's 1e-8 pu/s and rounding.
        assert verdict.ramp_violation < 2e-10
        assert verdict.bound_violation == 0.0
        assert verdict.feasible_strict
        assert verdict.objective == pytest.approx(solution.solver_objective, rel=1e-5)


def test_a_reused_program_gives_the_answer_of_a_fresh_one(case: Case, quiet_instance) -> None:
    """Other data, and other element lengths."""
    instances = [short(case, 0), ramping(case, quiet_instance, start=0.31, duration=1.07)]
    solve = prepare(case, "TO", Settings())
    solve(instances[1])
    for instance in instances:
        again = solve(instance)
        ends = element_ends(instance, len(again.schedule.t) - 1)
        fresh = RadauProgram(case, len(ends) - 1)
        outcome, x = run_ipopt(fresh.solver, fresh.arguments(instance, "TO", ends), 0.0)
        assert again.status == outcome.status == Status.OPTIMAL
        assert again.solver_objective == pytest.approx(outcome.objective, rel=1e-12)
        np.testing.assert_allclose(again.schedule.p, fresh.schedule(x, instance, ends).p, atol=1e-12)


def test_behind_an_infinite_machine_the_slack_is_paid_from_the_start(tmp_path, quiet_instance) -> None:
    """The claim on the detailed plant is what the scorer finds, t = 0 included."""
    case = detailed_case("two-area", tmp_path, "infinite").model_copy(update={"knots": 3})
    instance = quiet_instance(case, horizon_s=0.5)
    solution = prepare(case, "NO", Settings())(instance)
    found = score(case, instance, solution.schedule, "NO")
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-6)
