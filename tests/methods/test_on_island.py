"""Methods on an island: every machine is scheduled, the mean frequency and swings about it are bounded."""

from __future__ import annotations

import numpy as np
import pyomo.environ as pyo
import pytest
from scipy.signal import lsim

from ded_bench import load_instances
from ded_bench.files.errors import InputError
from ded_bench.methods import ed
from ded_bench.methods.ded_slp import OPEN
from ded_bench.methods.ed import first_schedules, slow_dispatch
from ded_bench.methods.knot_program import LEAST_PRICE, SOFT_PRICE, KnotProgram
from ded_bench.methods.knots import case_knots
from ded_bench.methods.radau_detailed import DetailedProgram, mesh
from ded_bench.methods.radau_program import POINTS
from ded_bench.methods.registry import METHODS, get_method
from ded_bench.methods.slp import Rows, solve_with_rows_added
from ded_bench.methods.solution import Settings
from ded_bench.methods.state_estimate import StateEstimate
from ded_bench.methods.surrogate_program import SOFT_TOLERANCE
from ded_bench.plants.detailed.detailed_plant import LEAST_LEAD_S, DetailedPlant
from ded_bench.plants.plant import PlantState, SimulationError, plant_of, simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.limits import Transfer
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.ipopt import CasadiIpopt
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import find_surrogate

#: What needs a lossless grid, a model that islands lack, or a policy.
REFUSING = [*(name for name, method in METHODS.items() if method.lossless), "ded-ko", "ded-admm"]
HORIZON = 8.0


def settings(method: str) -> Settings:
    return Settings(model="trajectory" if method == "ded-ko-knots" else None)


@pytest.mark.parametrize("every", [None, 4.0])
@pytest.mark.parametrize("lead", [False, True])
def test_base_points_start_at_p_0_and_keep_limits(
    island: Case, instance: Instance, every: float | None, lead: bool
) -> None:
    schedule = ed.dispatch(island, instance, every, lead)
    p_set = schedule.at(instance.grid)
    np.testing.assert_array_equal(p_set[0], instance.p_initial(island))
    assert (np.abs(np.diff(p_set, axis=0)) <= island.ramp * instance.dt_s + 1e-12).all()
    assert ((p_set >= island.p_min - 1e-12) & (p_set <= island.p_max + 1e-12)).all()
    if not lead:
        kinks = instance.kinks if every is None else []
        assert set(schedule.t) == {*np.arange(0.0, HORIZON + 0.5, every or 1.0), *kinks}


def test_turbines_deliver_what_is_led(island: Case) -> None:
    """(1 + s t2) / ((1 + s t1)(1 + s t3)) of the set-points, by another integrator."""
    dt_s, t = 0.01, np.arange(801) * 0.01
    wanted = 0.5 + 0.01 * np.outer(np.clip(t - 1.0, 0.0, 3.0), np.ones(len(island.generators)))
    p_set = plant_of(island).set_points_delivering(wanted, dt_s)
    machines = {machine.name: machine for machine in island.detailed.machines.values()}
    for name, column, target in zip(island.generators, p_set.T, wanted.T, strict=True):
        governor = machines[name].governor
        lags = np.polymul([governor.t1, 1.0], [governor.t3, 1.0])
        _, delivered, _ = lsim((np.trim_zeros([governor.t2, 1.0]), lags), column - 0.5, t)
        # Between grid points a jump of the set-point is a ramp; without a lead time, turbines lag.
        late = dt_s if governor.t2 > 0 else LEAST_LEAD_S
        np.testing.assert_allclose(delivered + 0.5, target, atol=0.01 * late)


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_what_ded_slp_confirms_is_what_the_scorer_finds(
    island: Case, instance: Instance, regime: str
) -> None:
    solution = get_method("ded-slp").prepare(island, regime, Settings())(instance)
    assert solution.status == Status.OPTIMAL
    found = score(island, instance, solution.schedule, regime)
    assert found.feasible_strict
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-6)


def test_outputs_of_condensed_programs_are_those_of_the_model(island: Case, instance: Instance) -> None:
    """Row by row, across resets by secondary control and intervals of any length."""
    points = np.delete(case_knots(island, instance), [2, 3, 6])
    schedule = Schedule(instance.grid[points], slow_dispatch(island, instance, points))
    model = plant_of(island).linearise_along(simulate(island, instance, schedule), points)
    program = KnotProgram(island, instance, island.bounds("TO"), model)
    rows, n_out = program._output_rows, len(program.bounds.limit)
    u = np.random.default_rng(0).normal(size=model.p_gen.shape) * 0.01
    u[0] = 0.0
    expected = program.model.outputs(u)[0]
    every = np.arange(n_out, len(expected) * n_out)
    change = (rows.matrix(every) @ u[1:].ravel()).reshape(-1, n_out)
    np.testing.assert_allclose(change, (expected - program.model.omega)[1:], rtol=0, atol=1e-13)


def followed(case: Case, instance: Instance, schedule: Schedule) -> tuple[PlantState, Instance, Schedule]:
    """After a second under a schedule: where the plant is, what is measured, what goes on."""
    plant, steps = plant_of(case), round(1.0 / instance.dt_s)
    passed, horizon = steps * instance.dt_s, instance.horizon_s
    p_set, p_load = schedule.at(instance.grid[: steps + 1]), instance.p_load(case)[: steps + 1]
    end = plant.advance(plant.initial(instance), p_set, p_load, instance.dt_s).end
    inside = schedule.t[(schedule.t > passed) & (schedule.t <= horizon)] - passed
    times = np.concatenate([[0.0], inside, [horizon]])
    measured = {"schema_": "ded-bench/instance/2", "initial": plant.observed(end).initial(case)}
    return end, instance.model_copy(update=measured), Schedule(times, schedule.at(times + passed))


def test_an_estimate_under_a_forecast_that_comes_true_is_the_state(island: Case, instance: Instance) -> None:
    """All of it, from plan to plan; what is measured alone leaves fluxes, exciters and gates open."""
    plant = plant_of(island)
    estimate, schedule = StateEstimate(plant), ed.dispatch(island, instance, None)
    estimate.keep(instance, estimate.initial(instance, None), schedule)
    true, later, in_force = followed(island, instance, schedule)
    found, blind = estimate.initial(later, in_force), plant.initial(later)
    np.testing.assert_allclose(found.x, true.x, rtol=0, atol=1e-9)
    assert np.abs(blind.x - true.x).max() > 1e-4
    other = Schedule(in_force.t, in_force.p + 1e-3)  # somebody else's plan
    np.testing.assert_array_equal(estimate.initial(later, other).x, blind.x)


@pytest.mark.parametrize("price", [None, LEAST_PRICE, SOFT_PRICE])
def test_condensed_programs_have_the_optimum_of_those_with_states(
    island: Case, instance: Instance, price: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the static dispatch, beyond its bounds; widened where no schedule can keep them."""
    points = case_knots(island, instance)
    schedule = Schedule(instance.grid[points], slow_dispatch(island, instance, points))
    model = plant_of(island).linearise_along(simulate(island, instance, schedule), points)
    bounds = island.bounds("TO").tightened(part=0.0 if price is None else 0.99)
    found, widened = [], []
    for condensed in (False, True):
        monkeypatch.setattr(KnotProgram, "condensed", condensed)
        program = KnotProgram(island, instance, bounds, model)
        if not condensed:
            limits = np.array(sorted(program.near(program.model.omega)))
        if price is None:
            answer = program.solve(limits, np.inf)
        else:
            answer, of_intervals = program.solve_relaxed(limits, np.inf, price)
            widened.append(of_intervals.sum())
        assert answer.status == Status.OPTIMAL
        found.append(program.predict(answer.x))
    with_states, without = found
    # Beside the price of a widening, what the cost is hardly counts for an interior point.
    same = 1e-7 if price is None else 1e-3
    assert without.objective == pytest.approx(with_states.objective, rel=same)
    if widened:
        # Prices of widenings are sums of all columns' costs, which differ.
        assert widened[1] == pytest.approx(widened[0], rel=2e-2)
        assert widened[0] > 10 * OPEN
        attempt = solve_with_rows_added(program, set(), Rows(OPEN, OPEN), np.inf)
        assert attempt.status == Status.INFEASIBLE
        assert attempt.wanted is not None
    else:
        assert bounds.beyond(without.outputs)[points[1:]].max() < 1e-9


def test_what_static_dispatch_serves_has_a_first_schedule() -> None:
    """Near the limit of its voltages 68bus-agc-0070 carries neither led governors nor shares of the load."""
    case = Case.load("68bus-agc")
    near = next(one for one in load_instances("68bus-agc") if one.id == "68bus-agc-0070")
    points, carried = case_knots(case, near), []
    for powers in first_schedules(case, near, slow_dispatch(case, near, points), points):
        try:
            simulate(case, near, Schedule(near.grid[points], powers), exact=False)
            carried.append(True)
        except SimulationError:
            carried.append(False)
    assert carried == [False, False, False, False, False, True]


@pytest.mark.parametrize(("horizon_s", "dt_s"), [(5.3, 0.01), (0.5, 0.01), (8.0, 2.0)])
def test_first_schedules_of_any_horizon_and_step(case: Case, horizon_s: float, dt_s: float) -> None:
    instance = sample_instance(case, 7, 0).model_copy(update={"horizon_s": horizon_s, "dt_s": dt_s})
    points = np.array([0, instance.steps])
    wanted = np.tile(instance.p_initial(case), (2, 1))
    assert all(np.isfinite(p).all() for p in first_schedules(case, instance, wanted, points))


def test_transfers_are_limits_of_programs(island: Case, instance: Instance) -> None:
    """What two machines deliver beyond a load is held below what it would be, at every grid point."""
    free = get_method("ded-slp").prepare(island, "NO", Settings())(instance).schedule.at(instance.grid)
    by, bus = ["south", "north-a"], island.loads[0]
    drawn = -instance.p_load(island)[:, 0]
    of = [island.generators.index(name) for name in by]
    beyond = free[:, of].sum(axis=1) - drawn
    limit = (beyond[0] + beyond.max()) / 2
    assert beyond.max() > limit + 0.01
    transfer = Transfer(name="cut", machines=tuple(by), loads=(bus,), max=limit)
    held = island.model_copy(update={"transfers_": (transfer,)})
    solution = get_method("ded-slp").prepare(held, "NO", Settings())(instance)
    assert solution.status == Status.OPTIMAL
    p_set = solution.schedule.at(instance.grid)
    assert held.transfer_excess(p_set, instance.p_load(island)).max() < 1e-6


@pytest.mark.parametrize(("method", "share"), [("ded-rti", 2 * SOFT_TOLERANCE), ("ded-ko-knots", 0.2)])
def test_programs_along_trajectories_nearly_keep_bounds(
    island: Case, instance: Instance, method: str, share: float
) -> None:
    """ded-rti's second program is along a trajectory near its answer, the only one of the other is not."""
    solution = get_method(method).prepare(island, "TO", settings(method))(instance)
    found = score(island, instance, solution.schedule, "TO")
    best = get_method("ded-slp").prepare(island, "TO", Settings())(instance)
    assert found.objective == pytest.approx(best.solver_objective, rel=1e-3)
    assert found.freq_violation_hz < share * island.regimes["TO"].relative_hz


@pytest.mark.parametrize("method", REFUSING)
def test_others_refuse_with_one_line(island: Case, instance: Instance, method: str) -> None:
    for model in (None, "linear"):
        with pytest.raises(InputError) as refusal:
            get_method(method).prepare(island, "TO", Settings(model=model))(instance)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("case", "method", "options"),
    [("island", "ded", "default"), ("island", "ded-ko", "default"), ("threebus", "ed", "lead=on")],
)
def test_a_case_that_a_method_does_not_plan_on(case: str, method: str, options: str, request) -> None:
    """Before any row is made."""
    with pytest.raises(InputError, match=r"has no lossless network|has no slack|needs an island"):
        get_method(method).artifacts(request.getfixturevalue(case), "TO", Settings(options))


def test_one_solver_for_instances_of_different_grids_of_time(island: Case, instance: Instance) -> None:
    """The same grid points at other times make other maps."""
    other = instance.model_copy(update={"id": "other", "dt_s": instance.dt_s / 2}).until(
        instance.horizon_s / 2
    )
    points = np.arange(0, instance.steps + 1, 100)
    p_gen = np.tile(instance.p_initial(island), (len(points), 1))
    used, fresh = (find_surrogate(island, "linear", ()) for _ in range(2))
    used.along(other, p_gen, points)
    expected, found = fresh.along(instance, p_gen, points), used.along(instance, p_gen, points)
    np.testing.assert_array_equal(found.across.f, expected.across.f)


def test_islands_start_at_rest_whatever_is_drawn(island: Case) -> None:
    sampling = island.sampling.model_copy(update={"omega_rad_per_s": (-0.01, 0.01)})
    drawn = sample_instance(island.model_copy(update={"sampling": sampling}), 7, 0)
    assert set(drawn.initial.omega.values()) == {0.0}


def test_collocation_and_linear_programs_find_the_same_optimum(island: Case, instance: Instance) -> None:
    """They share the plant's data and nothing else; IPOPT's barrier and the grid's trapezoids cost 1e-5.

    Collocation bounds swings at its points alone: between them they exceed the bound by some per cent,
    which is worth 3e-5 of the cost.
    """
    island = island.model_copy(update={"knots": 11})
    answer = get_method("ded-radau").prepare(island, "TO", Settings("element_s=1"))(instance)
    assert answer.status == Status.OPTIMAL
    found = score(island, instance, answer.schedule, "TO")
    assert found.freq_violation_hz < 0.05 * island.regimes["TO"].relative_hz
    assert max(found.ramp_violation, found.bound_violation, found.initial_violation) <= 1e-8
    assert answer.solver_objective == pytest.approx(found.objective, rel=1e-6)
    best = get_method("ded-slp").prepare(island, "TO", Settings())(instance)
    assert found.objective == pytest.approx(best.solver_objective, rel=4e-5)


def test_collocated_equations_are_the_plants(island: Case, instance: Instance) -> None:
    """Where set-points are given, what the equations say comes near what is simulated as elements shrink."""
    plant, errors = DetailedPlant(island.model_copy(update={"knots": 6})), []
    instance = instance.until(5.0)  # secondary control acts once
    state = plant.initial(instance)
    for longest in (0.5, 0.25):
        points = mesh(plant, instance, state, longest)
        program = DetailedProgram(plant, instance, "NO", state, points)
        program.start()
        program.model.p_set.fix()
        for name in ("ramps", "transfers", "frequencies"):
            program.model.component(name).deactivate()
        assert CasadiIpopt(program.model, {"tol": 1e-10}).solve().status == Status.OPTIMAL
        simulated = simulate(island, instance, program.schedule())
        omega, held = np.vectorize(pyo.value)(program._x[:: len(POINTS), program._speed]), program.model.held
        errors.append(np.abs(omega - simulated.omega[points.ends]).max() / (2 * np.pi))
    assert errors[1] < min(errors[0] / 4, 1e-5)
    assert held[1].value == pytest.approx(simulated.columns["agc"][points.acts[0]], abs=1e-6)
    total = simulated.cost(instance.cost_gen(island), 0.0)
    assert pyo.value(program.model.cost_total) == pytest.approx(total, rel=1e-7)


def test_collocation_refuses_what_memory_does_not_hold() -> None:
    case = Case.load("39bus-agc")
    answer = get_method("ded-radau").prepare(case, "TO", Settings())(load_instances("39bus-agc", limit=1)[0])
    assert answer.schedule is None
    assert "GiB" in answer.error
