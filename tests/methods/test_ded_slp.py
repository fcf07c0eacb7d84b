"""Programs along simulated trajectories: they claim what the scorer finds, and statuses are honest."""

from __future__ import annotations

import dataclasses
import functools
import json

import numpy as np
import pytest

from ded_bench.files.strict import parse_record
from ded_bench.methods import ded_slp, ed, knot_columns, knot_program
from ded_bench.methods.ded_slp import prepare
from ded_bench.methods.knot_columns import FixedSetPoints
from ded_bench.methods.knot_program import KnotProgram, Plan
from ded_bench.methods.registry import get_method
from ded_bench.methods.slp import Attempt, Parts, Rows, solve_with_rows_added
from ded_bench.methods.solution import Settings
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE
from ded_bench.plants.plant import SimulationError, plant_of, simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Bounds
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import OnArrays
from ded_bench.solvers.linear_program import FormAnswer, FreeForm
from ded_bench.solvers.status import Status
from tests.conftest import CASE_FILES
from tests.methods import on_surrogates
from tests.methods.pyomo_models import build_ded_slp
from tests.solvers.test_solvers import FORM

HORIZON = 4.0
POINTS = np.array([0, 60, 121, 130, 205, 300, 400])


short = functools.partial(on_surrogates.short, horizon_s=HORIZON)


def program(case: Case, instance: Instance, bounds: Bounds, points=POINTS) -> KnotProgram:
    """The program around the static dispatch."""
    times = instance.grid[points]
    schedule = Schedule(t=times, p=ed.dispatch(case, instance, 1.0).at(times))
    model = plant_of(case).linearise_along(simulate(case, instance, schedule), points)
    return KnotProgram(case, instance, bounds, model)


def test_pieces_within_which_the_slack_s_power_cancels_are_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one piece an interval the answer would be 7e-5 dearer than with one a grid point."""
    case, costs = Case.load(CASE_FILES["fivemachine"]), []
    for piece in (1, 1000):
        monkeypatch.setattr(knot_columns, "PIECE", piece)
        solution = prepare(case, "NO", Settings())(sample_instance(case, 77, 0))
        assert solution.status == Status.OPTIMAL
        costs.append(solution.solver_objective)
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_slack_s_power_that_keeps_its_sign_is_priced_alike(seed, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without the rows of the other sign; where it changes after all, they are added."""
    case, answers = Case.load(CASE_FILES["fivemachine"]), []
    for steady in (0.0, 1.0):
        monkeypatch.setattr(knot_columns, "STEADY", steady)
        solution = prepare(case, "NO", Settings())(sample_instance(case, 77, seed))
        assert solution.status == Status.OPTIMAL
        answers.append(solution.solver_objective)
    assert answers[0] == pytest.approx(answers[1], rel=1e-6)


def test_where_rows_of_one_sign_fail_there_are_those_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with one program of the 68-bus grid, in which PIQP makes no progress."""
    case, tried = Case.load(CASE_FILES["fivemachine"]), []
    monkeypatch.setattr(knot_columns, "STEADY", 0.0)
    solve = knot_program.solve_form

    def fails_first(form: FreeForm, *arguments: float, **options: bool) -> FormAnswer:
        tried.append(form.between.shape[0])
        answer = solve(form, *arguments, **options)
        return answer if len(tried) > 1 else dataclasses.replace(answer, status=Status.FAILED)

    monkeypatch.setattr(knot_program, "solve_form", fails_first)
    answer = program(case, short(case, 0), case.bounds("NO")).solve(np.empty((0, 3), dtype=int), np.inf)
    assert answer.status == Status.OPTIMAL
    assert len(tried) == 2
    assert tried[0] < tried[1]


def test_what_is_fixed_wrongly_is_told_and_set_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """2 x + 3 y is least at (2, 1); with y at its limit of 0.8 a unit more of it would save 1."""
    form, u, fixed = (
        dataclasses.replace(FORM, lower=np.array([0.0, 0.8])),
        np.array([[1]]),
        FixedSetPoints((1, 1)),
    )
    monkeypatch.setattr(knot_columns, "LEAST_GENERATORS", 1)
    fixed.at[0] = True
    answer = knot_program.solve_form(fixed.in_program(form, u))
    assert answer.x == pytest.approx([2.4, 0.8], abs=1e-6)
    assert answer.reduced_cost == pytest.approx([0.0, -1.0], abs=1e-6)
    fixed.choose(form, u, answer)
    assert fixed.gap == pytest.approx(3.0 - 0.8)
    assert not fixed.at.any()


def test_set_points_fixed_wrongly_are_set_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program on a surrogate is the only one: no simulation would tell."""
    monkeypatch.setattr(knot_columns, "LEAST_GENERATORS", 1)
    case, dearer = Case.load(CASE_FILES["fivemachine"]), 0
    instance, bounds = short(case, 0), case.bounds("NO")
    model, rows = program(case, instance, bounds).model, Rows(1e-7, 1e-7)
    for generator in range(len(case.generators)):
        costs = []
        for is_fixed in (False, True):
            made = KnotProgram(case, instance, bounds, model)
            made.fixed.at[1, -1, generator] = is_fixed  # at its upper limit, at the last knot
            answer = made.solve(np.empty((0, 3), dtype=int), np.inf)
            costs += [made.predict(answer.x).objective]
            made.fixed.at[1, -1, generator] = is_fixed
            attempt = solve_with_rows_added(made, set(), rows, np.inf)
            costs += [attempt.solution.objective]
        dearer += costs[2] > costs[0] * (1 + 1e-5)
        assert costs[3] == pytest.approx(costs[1], rel=2e-6)
    assert dearer


@pytest.mark.parametrize("everywhere", [False, True])
def test_set_points_fixed_at_limits_change_no_optimum(
    everywhere: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that the last program had there; where that leaves no solution, all are free again."""
    monkeypatch.setattr(knot_columns, "AROUND", 0)
    monkeypatch.setattr(knot_columns, "LEAST_GENERATORS", 1)
    case, none = Case.load(CASE_FILES["fivemachine"]), np.empty((0, 3), dtype=int)
    made = program(case, short(case, 0), case.bounds("TO"))
    whole = made.solve(none, np.inf)
    assert made.fixed.at.any()
    made.fixed.at[0] |= everywhere
    smaller = made.solve(none, np.inf)
    assert (whole.status, smaller.status) == (Status.OPTIMAL, Status.OPTIMAL)
    assert made.predict(smaller.x).objective == pytest.approx(made.predict(whole.x).objective, rel=1e-6)
    assert made.fixed.gap <= 1e-6 * made.predict(whole.x).objective


@pytest.mark.parametrize(("index", "stage"), [(0, 1), (0, 4), (1, 2), (1, 6)])
def test_program_is_the_model_with_every_point(case, index, stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """HiGHS on the Pyomo model with a state, a limit and |P_s| at every grid point finds the same optimum."""
    monkeypatch.setattr(KnotProgram, "_stage", lambda _: stage)
    instance, bounds = short(case, index), case.bounds("TO")
    made = program(case, instance, bounds)
    limits = [
        (g, k) for g in range(len(case.generators)) for k in range(1, instance.steps) if k not in POINTS
    ]
    answer = made.solve(np.array(limits), np.inf)
    assert answer.status == Status.OPTIMAL
    prediction = made.predict(answer.x)
    whole = build_ded_slp(case, instance, bounds, made.model)
    outcome = OnArrays(whole, "highs").solve()
    assert outcome.status == Status.OPTIMAL
    # Within a piece P_s of both signs costs the program too little: its answer may be a little dearer,
    # the more so the shorter the horizon is.
    assert outcome.objective <= prediction.objective * (1 + 1e-8)
    assert prediction.objective == pytest.approx(outcome.objective, rel=2e-4)
    assert bounds.beyond(prediction.outputs)[1:].max() <= 1e-7


@pytest.mark.parametrize(("soft", "tolerance"), [(False, 1e-6), (True, 1e-5)])  # what may be left open
def test_limits_within_stages_get_rows_where_they_are_needed(case, soft, tolerance, monkeypatch) -> None:
    """Along a trajectory that comes near none of them the optimum is that of a program with all of them."""
    instance, bounds, answers = short(case, 0), case.bounds("TO"), []
    monkeypatch.setattr(knot_program, "HELD_AGAIN", 1e9)
    for stage in (1, 3):
        monkeypatch.setattr(KnotProgram, "_stage", lambda _, stage=stage: stage)
        first = program(case, instance, bounds)
        made = KnotProgram(case, instance, bounds, first.model, Plan(None) if soft else None, before=first)
        left = SOFT_TOLERANCE * float(bounds.limit.min()) if soft else 1e-7
        attempt = solve_with_rows_added(made, set(), Rows(left, left, soft), np.inf)
        assert attempt.status == Status.OPTIMAL
        answers.append(attempt.solution.objective)
    assert answers[1] == pytest.approx(answers[0], rel=tolerance)


@pytest.mark.parametrize("regime", ["NO", "TO"])
@pytest.mark.parametrize("index", range(2))
def test_claims_are_what_the_scorer_finds(case, regime, index):
    """Strictly feasible, and the cost to 1e-6."""
    instance = short(case, index)
    solution = prepare(case, regime, Settings())(instance)
    assert solution.status == Status.OPTIMAL
    found = score(case, instance, solution.schedule, regime)
    assert found.feasible_strict
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-6)


def test_what_does_not_converge_says_so(case, monkeypatch):
    """No trajectory counts as one that keeps the bound."""
    monkeypatch.setattr(ded_slp, "ACCEPTED", -np.inf)
    monkeypatch.setattr(ded_slp, "Parts", functools.partial(Parts, most_programs=2))
    solution = prepare(case, "NO", Settings())(short(case, 1))
    assert (solution.status, solution.schedule) == (Status.FAILED, None)
    assert solution.error == "no convergence in 2 programs"


def test_no_schedule_on_the_knots_nearby_is_cheaper(case):
    """Feasible schedules between the answer and that to other costs, on the same knots, cost more."""
    instance, rng = short(case, 1), np.random.default_rng(3)
    solve = prepare(case, "TO", Settings())
    best = solve(instance).schedule
    other = solve(instance.model_copy(update={"cost": short(case, 0).cost})).schedule.p
    assert np.abs(other - best.p).max() > 1e-3
    cheapest = score(case, instance, best, "TO").objective
    feasible = 0
    for part in (1e-3, 1e-2, *rng.uniform(0.0, 1.0, size=6)):
        mixed = Schedule(t=best.t, p=best.p + part * (other - best.p))
        found = score(case, instance, mixed, "TO")
        feasible += found.feasible_strict
        # The bound is kept with a margin, which costs a little on so short a horizon.
        assert not found.feasible_strict or found.objective >= cheapest * (1 - 2e-5)
    assert feasible


def test_starts_from_an_earlier_solution(case, monkeypatch):
    """It confirms its own answer with one program or two, and no more than a cold start takes."""
    programs, solve = [], KnotProgram.solve
    monkeypatch.setattr(KnotProgram, "solve", lambda *args: programs.append(args) or solve(*args))
    instance, solver = short(case, 0), prepare(case, "TO", Settings())
    cold, count = solver(instance), len(programs)
    warm = solver.solve(instance, last=cold)
    assert warm.status == Status.OPTIMAL
    assert len(programs) - count <= min(count, 2)
    found = [score(case, instance, s.schedule, "TO").objective for s in (cold, warm)]
    assert found[1] == pytest.approx(found[0], rel=1e-5)


def test_finer_knots_cost_no_more(ninebus):
    """The schedules on 0.1 s knots include nearly all those on 50 knots."""
    instance = sample_instance(ninebus, 77, 5).model_copy(update={"horizon_s": 12.0})
    costs = []
    for options in ("default", "knot_s=0.1"):
        solution = prepare(ninebus, "TO", Settings(options))(instance)
        costs.append(score(ninebus, instance, solution.schedule, "TO").objective)
    assert len(solution.schedule.t) == 121
    assert costs[1] <= costs[0] * (1 + 1e-5)


def test_knots_further_apart_than_the_horizon_are_its_ends(case):
    solution = prepare(case, "NO", Settings(f"knot_s={9 * HORIZON}"))(short(case, 0))
    assert solution.status in (Status.OPTIMAL, Status.INFEASIBLE)


def test_failures_are_said(case, monkeypatch):
    """A system that loses synchronism under every schedule."""

    def lost(*args, **named):
        raise SimulationError("lost")

    monkeypatch.setattr(ded_slp, "simulate", lost)
    solution = prepare(case, "TO", Settings())(short(case, 0))
    assert solution.status == Status.FAILED
    assert solution.error == "lost"


def test_a_program_that_was_too_careful_is_not_the_last(alter) -> None:
    """Its trajectory stays clear of a bound that held it, at just the cost it said: the slack is free."""
    case = alter(Case.load("two-area"), ramp_pu_per_s=0.5, regimes={"TO": {"omega_hz": 0.03}}, knots=4)
    power, omega = {"g1": 8.96, "g2": 6.993102, "g4": 3.5}, {"g1": 0.056548, "g2": 0.056548, "g4": -0.056548}
    data = {
        **{"schema": "ded-bench/instance/2", "id": "careful", "case": "two-area", "seed": [1, 1]},
        **{"horizon_s": 8.0, "dt_s": 0.1, "initial": {"power": power, "omega": omega}},
        "cost": {"g3": 0.0, "g1": 0.3, "g2": 0.9828, "g4": 0.3403},
        "load": {
            "7": {"initial": -8.97473, "start": 1.99889, "duration": 2.23837, "rate": -0.0199167},
            "9": {"initial": -18.3045, "start": 1.86961, "duration": 4.89043, "rate": -0.0161650},
        },
    }
    instance = parse_record(Instance, json.dumps(data), "careful instance")
    careful = prepare(case, "TO", Settings())(instance)
    other = get_method("ded-rti").prepare(case, "TO", Settings())(instance)
    assert careful.status == Status.OPTIMAL
    assert careful.solver_objective < 1.0001 * score(case, instance, other.schedule, "TO").objective


def test_what_is_feasible_but_not_confirmed_is_no_optimum(case, monkeypatch):
    """With no agreement of costs ever, the best strictly feasible schedule is all that is claimed."""
    monkeypatch.setattr(ded_slp, "COST_TOLERANCE", -1.0)
    instance = short(case, 0)
    solution = prepare(case, "NO", Settings())(instance)
    assert solution.status == Status.FEASIBLE
    assert solution.solver_objective is None
    assert score(case, instance, solution.schedule, "NO").feasible_strict


def test_a_feasible_schedule_in_hand_is_not_called_infeasible(case, monkeypatch):
    """Programs keep a margin, and may have no answer where static dispatch keeps the bound itself."""
    none = Attempt(Status.INFEASIBLE, None, None, 1, "none", "no answer")
    monkeypatch.setattr(ded_slp, "solve_with_rows_added", lambda *args: none)
    instance = short(case, 0)
    solution = prepare(case, "NO", Settings())(instance)
    assert solution.status == Status.FEASIBLE
    assert score(case, instance, solution.schedule, "NO").feasible_strict


def test_in_operation_what_cannot_be_met_is_exceeded_least(case, alter):
    """The sum over knot intervals of the largest excess is below that of what is optimal at looser bounds."""
    instance = short(case, 0)
    initial = instance.model_dump(by_alias=True)["initial"]
    fast = alter(instance, initial=initial | {"omega": dict.fromkeys(case.generators, 0.05)})
    knots, bound = np.rint(case.knot_times(HORIZON) / fast.dt_s).astype(int), case.omega_bound("TO")

    def excess(schedule):
        over = np.abs(simulate(case, fast, schedule).omega[1:]).max(axis=1) - bound
        return np.maximum(np.maximum.reduceat(over, knots[:-1]), 0.0).sum()

    solution = prepare(case, "TO", Settings()).solve(fast)
    assert (solution.status, solution.error) == (Status.INFEASIBLE, Status.INFEASIBLE.sentence)
    least = excess(solution.schedule)
    assert least > 0
    loose = case.regimes["TO"].model_copy(update={"omega_hz": 0.05 / (2 * np.pi)})
    others = [prepare(case.model_copy(update={"regimes": {"TO": loose}}), "TO", Settings())(fast).schedule]
    others.append(ed.dispatch(case, fast, 1.0))
    assert least < 0.999 * min(map(excess, others))
