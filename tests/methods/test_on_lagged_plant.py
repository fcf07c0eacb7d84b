"""Methods that linearise, on a plant with other powers than its set-points and three states a machine."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.ed import slow_dispatch
from ded_bench.methods.knot_program import KnotProgram
from ded_bench.methods.registry import METHODS, get_method
from ded_bench.methods.slp import Rows, solve_with_rows_added
from ded_bench.methods.solution import Settings
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.limits import IslandRegime
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.compile import OnArrays
from ded_bench.solvers.status import Status
from tests.lagged_plant import LAG_S, lagged, lagged_case
from tests.methods.on_surrogates import short
from tests.methods.pyomo_models import build_ded_slp

__all__ = ["lagged"]
POINTS = np.array([0, 60, 121, 130, 205, 300])


@pytest.fixture
def slow(case: Case, lagged: None) -> Case:
    return lagged_case(case)


def test_the_case_names_its_plant(slow: Case, ninebus: Case) -> None:
    plant = plant_of(slow)
    assert plant.name == "lagged"
    assert plant_of(slow, "lossless").name == plant_of(ninebus).name == "lossless"
    assert plant.fingerprint != plant_of(slow, "lossless").fingerprint


@pytest.mark.parametrize("name", [*(n for n, method in METHODS.items() if method.lossless), "ded-radau"])
def test_what_has_its_own_equations_of_the_lossless_plant_refuses(slow: Case, name: str) -> None:
    with pytest.raises(InputError, match=r"has no lossless network|no equations of plant lagged"):
        get_method(name).prepare(slow, "TO", Settings())


def test_delivered_powers_lag_behind_a_ramp(slow: Case, quiet_instance) -> None:
    """A ramp of r is followed by r (t - T (1 - exp(-t / T)))."""
    instance, rate = quiet_instance(slow, horizon_s=4.0), 0.01
    ends = slow.p_nominal + rate * np.array([[0.0], [instance.horizon_s]])
    run = simulate(slow, instance, Schedule(np.array([0.0, instance.horizon_s]), ends))
    lagging = instance.grid - LAG_S * (1.0 - np.exp(-instance.grid / LAG_S))
    expected = slow.p_nominal + rate * lagging[:, None] * np.ones(len(slow.generators))
    np.testing.assert_allclose(run.p_gen, expected, atol=1e-12)


def test_the_linearisation_has_the_derivatives_of_simulations(slow: Case) -> None:
    """Central differences: of ω and P_s at all points, and of what is paid."""
    instance = short(slow, 1)
    plant, p_gen = plant_of(slow), slow_dispatch(slow, instance, POINTS)
    along = simulate(slow, instance, Schedule(instance.grid[POINTS], p_gen))
    model, prices = plant.linearise_along(along, POINTS), instance.cost_gen(slow)
    change = np.random.default_rng(1).normal(size=p_gen.shape)
    change[0] = 0.0
    size = 1e-4
    runs = [
        simulate(slow, instance, Schedule(instance.grid[POINTS], p_gen + sign * size * change))
        for sign in (1, -1)
    ]

    def slope(values: list[Array]) -> Array:
        return (values[0] - values[1]) / (2 * size)

    omega, p_slack = model.outputs(change)
    wanted = slope([run.omega for run in runs])
    # The linear model's stiffness is that of the middle of each interval.
    np.testing.assert_allclose(omega - model.omega, wanted, atol=0.02 * np.abs(wanted).max())
    wanted = slope([run.p_slack for run in runs])
    np.testing.assert_allclose(p_slack - model.p_slack, wanted, atol=0.02 * np.abs(wanted).max())
    paid, rows, x = (
        slope([run.p_gen @ prices for run in runs]).sum(),
        model.cost_rows(prices),
        model.states(change),
    )
    told = (rows.x * x[:-1]).sum() + (rows.start * change[:-1] + rows.end * change[1:]).sum()
    assert told == pytest.approx(paid, rel=1e-8)


def test_the_program_is_the_model_with_every_point(slow: Case) -> None:
    """HiGHS on the Pyomo model, in which what is delivered is paid, finds the same optimum.

    Mean, swings and end are bounded; `test_ded_slp` bounds every speed.
    """
    instance, hz = short(slow, 0), slow.regimes["TO"].omega_hz
    bounds = IslandRegime(mean_hz=hz, relative_hz=hz, end_hz=hz / 5).bounds(slow.inertia)
    p_gen = slow_dispatch(slow, instance, POINTS)
    along = simulate(slow, instance, Schedule(instance.grid[POINTS], p_gen))
    model = plant_of(slow).linearise_along(along, POINTS)
    program = KnotProgram(slow, instance, bounds, model)
    attempt = solve_with_rows_added(program, set(), Rows(1e-7, 1e-7), np.inf)
    outcome = OnArrays(build_ded_slp(slow, instance, bounds, model), "highs").solve()
    assert attempt.status == outcome.status == Status.OPTIMAL
    # Within a piece P_s of both signs costs the program too little.
    assert outcome.objective <= attempt.solution.objective * (1 + 1e-8)
    assert attempt.solution.objective == pytest.approx(outcome.objective, rel=2e-4)


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_what_ded_slp_confirms_is_what_the_scorer_finds(slow: Case, regime: str) -> None:
    """Strictly feasible on the lagged plant, at the cost of what is delivered, and not so on the other."""
    instance = short(slow, 2)
    solution = get_method("ded-slp").prepare(slow, regime, Settings())(instance)
    assert solution.status == Status.OPTIMAL
    found = score(slow, instance, solution.schedule, regime)
    assert found.feasible_strict
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-6)
    other = score(slow, instance, solution.schedule, regime, plant_of(slow, "lossless"))
    assert other.objective != pytest.approx(found.objective, rel=1e-6)


def test_real_time_iterations_keep_the_bound(slow: Case) -> None:
    instance = short(slow, 0)
    solution = get_method("ded-rti").prepare(slow, "TO", Settings())(instance)
    assert solution.status == Status.FEASIBLE
    found = score(slow, instance, solution.schedule, "TO")
    assert found.freq_violation_hz < 0.05 * slow.regimes["TO"].omega_hz
    assert solution.solver_objective == pytest.approx(found.objective, rel=1e-3)
