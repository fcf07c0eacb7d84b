"""`ded-slp` on the full AC network: its linear models are derivatives, its claims what the scorer finds."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.koopman.ac_trajectory import linearise_along_ac
from ded_bench.methods import ded_ko_knots, ded_slp, ded_slp_ac
from ded_bench.methods.solution import Settings
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.ac_simulate import score_ac, simulate_ac

TWO_AREA = Case.load("two-area")
DATA = AcCase.of(TWO_AREA)
HORIZON = 8.0


def short(index: int) -> Instance:
    """A validation instance with an AC equilibrium, its loads moved to the start."""
    instance = sample_instance(TWO_AREA, VALIDATION_SEED, index)
    load = {bus: ramp.model_copy(update={"start": 1.0}) for bus, ramp in instance.load.items()}
    return instance.model_copy(update={"horizon_s": HORIZON, "load": load})


def test_linear_model_is_the_derivative():
    """Half the input increment leaves a quarter of the error; slack power has its losses."""
    instance, points = short(28), np.array([0, 50, 100, 160, 400, 800])
    times = instance.grid[points]
    p_gen = np.tile(instance.p_initial(TWO_AREA), (len(points), 1))
    along = simulate_ac(TWO_AREA, DATA, instance, Schedule(times, p_gen))
    model = linearise_along_ac(AcNetwork(TWO_AREA, DATA), along, points)
    u = np.zeros(p_gen.shape)
    u[1:] = 0.02 * np.random.default_rng(3).uniform(-1, 1, u[1:].shape)
    errors, sizes = [], []
    for part in (1.0, 0.5):
        true = simulate_ac(TWO_AREA, DATA, instance, Schedule(times, p_gen + part * u))
        omega, p_slack = model.outputs(part * u)
        errors.append([np.abs(omega - true.omega).max(), np.abs(p_slack - true.p_slack).max()])
        sizes.append([np.abs(true.omega - along.omega).max(), np.abs(true.p_slack - along.p_slack).max()])
    # Between the middles of intervals the stiffness is that of the middle: a first-order part is left.
    assert (np.array(errors) < 0.02 * np.array(sizes)).all()
    rough = simulate_ac(TWO_AREA, DATA, instance, Schedule(times, p_gen + u))
    lossless = -(rough.p_gen - along.p_gen).sum(axis=1)
    assert np.abs(rough.p_slack - along.p_slack - lossless).max() > 10 * errors[0][1]


@pytest.mark.parametrize("index", [28, 21])
def test_claims_what_the_scorer_finds(index):
    instance = short(index)
    solution = ded_slp_ac.prepare(TWO_AREA, "TO", Settings("ac"))(instance)
    assert solution.status == Status.OPTIMAL
    assert solution.schedule is not None
    found = score_ac(TWO_AREA, DATA, instance, solution.schedule, "TO")
    assert found.feasible_strict
    assert found.objective == pytest.approx(solution.solver_objective, rel=1e-6)
    lossless = ded_slp.prepare(TWO_AREA, "TO", Settings())(instance)
    assert lossless.schedule is not None
    assert not score_ac(TWO_AREA, DATA, instance, lossless.schedule, "TO").feasible


def test_shorter_steps_where_the_network_carries_little_more():
    """The static dispatch has no solution on this instance, and full steps lead to where there is none."""
    instance = short(16)
    solution = ded_slp_ac.prepare(TWO_AREA, "TO", Settings("ac"))(instance)
    assert solution.status in (Status.OPTIMAL, Status.FEASIBLE)
    assert solution.schedule is not None
    assert score_ac(TWO_AREA, DATA, instance, solution.schedule, "TO").feasible_strict


def test_instances_beyond_the_network_fail_honestly():
    """A draw without an equilibrium at t = 0."""
    solution = ded_slp_ac.prepare(TWO_AREA, "TO", Settings("ac"))(short(0))
    assert solution.status == Status.FAILED
    assert solution.schedule is None
    assert "no solution" in solution.error


def test_surrogate_along_an_ac_simulation():
    """One linear program along the AC simulation of a schedule comes nearer than along the lossless one."""
    instance, excess = short(28), {}
    for model in ("trajectory", "trajectory-ac"):
        solution = ded_ko_knots.prepare(TWO_AREA, "TO", Settings(model=model))(instance)
        assert solution.status == Status.OPTIMAL
        assert solution.schedule is not None
        excess[model] = score_ac(TWO_AREA, DATA, instance, solution.schedule, "TO").freq_violation_hz
    assert excess["trajectory-ac"] < 0.5 * excess["trajectory"]


def test_cases_without_ac_data():
    with pytest.raises(InputError, match="no AC data"):
        ded_slp_ac.prepare(Case.load("9bus"), "TO", Settings("ac"))


def test_no_claim_of_what_is_not_feasible():
    """Deviations beyond the bound at t = 0: no schedule; in operation one, which is called infeasible."""
    instance = short(28)
    started = {bus: 1.5 * TWO_AREA.omega_bound("TO") for bus in TWO_AREA.generators}
    moving = instance.model_copy(update={"initial": instance.initial.model_copy(update={"omega": started})})
    solver = ded_slp_ac.prepare(TWO_AREA, "TO", Settings("ac"))
    alone = solver(moving)
    assert alone.status in (Status.FAILED, Status.INFEASIBLE)
    assert alone.schedule is None
    assert alone.error
    operated = solver.solve(moving)
    assert operated.status == Status.INFEASIBLE
    assert operated.schedule is not None
