"""The detailed plant linearised: second order, AGC, delivered powers, rows; refusals."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from tests.detailed_cases import MIXED, detailed_case

#: Knots at unequal distances; secondary control acts every 200 points.
POINTS = np.array([0, 37, 120, 200, 283, 400, 455, 600, 640, 700])


@pytest.fixture(scope="module", params=["mixed", "39bus-infinite"])
def made(request, quiet_instance, constant, tmp_path_factory):
    """Plant, instance, resting trajectory, linearisation along it."""
    case = Case.load(MIXED)
    if request.param != "mixed":
        case = detailed_case("39bus", tmp_path_factory.mktemp("case"), "infinite")
    plant, instance = plant_of(case), quiet_instance(case, horizon_s=7.0)
    trajectory = simulate(case, instance, constant(instance, case.p_nominal))
    return plant, instance, trajectory, plant.linearise_along(trajectory, POINTS)


def increments(model, size):
    u = size * np.random.default_rng(5).normal(size=model.p_gen.shape)
    u[0] = 0.0
    return u


def test_error_is_of_second_order(made):
    """Along an equilibrium, against simulations: half the increments, a quarter of the error."""
    plant, instance, _, model = made
    errors = []
    for size in (0.2, 0.1, 0.05):
        u = increments(model, size)
        moved = simulate(plant.case, instance, Schedule(instance.grid[POINTS], model.p_gen + u))
        omega, p_slack = model.outputs(u)
        delivered = model.delivered
        p_gen = delivered.p_gen[POINTS[:-1]] + np.einsum("jgi,ji->jg", delivered.c, model.states(u)[:-1])
        errors.append([np.abs(omega - moved.omega).max(), np.abs(p_gen - moved.p_gen[POINTS[:-1]]).max()])
        errors[-1].append(np.abs(p_slack - moved.p_slack).max() or errors[-1][0])
    assert np.divide(errors[:-1], errors[1:]) == pytest.approx(4.0, rel=0.3)
    assert errors[-1][0] < 0.01 * np.abs(moved.omega).max()


def test_rows_are_those_of_the_rollout(made):
    """Frequencies at single points and sums of cost, from the variables of their intervals."""
    plant, instance, trajectory, model = made
    u = increments(model, 0.1)
    x, n = model.states(u), len(plant.case.generators)
    points = np.repeat([37, 38, 200, 201, 399, 400, 401, 699], n)
    rows = model.output_rows(np.tile(np.arange(n), 8), points)
    expected = (model.outputs(u)[0] - trajectory.omega)[points, np.tile(np.arange(n), 8)]

    def valued(rows):
        parts = (rows.x, x[rows.interval]), (rows.start, u[rows.interval]), (rows.end, u[rows.interval + 1])
        return sum(np.einsum("ri,ri->r", *part) for part in parts)

    np.testing.assert_allclose(valued(rows), expected, rtol=0, atol=1e-12)
    cost = np.linspace(0.2, 1.0, n)
    moved = simulate(plant.case, instance, Schedule(instance.grid[POINTS], model.p_gen + 1e-3 * u))
    more = ((moved.p_gen - trajectory.p_gen) @ cost).sum() / 1e-3
    assert valued(model.cost_rows(cost)).sum() == pytest.approx(more, rel=1e-3)


def test_a_step_is_the_exponential(made):
    plant, instance, _, model = made
    system = plant.system
    modes = system.modes(system.network.nominal())
    moving = np.exp(modes * instance.dt_s)
    mapped = np.linalg.eigvals(model.step.f[0])
    for mode in moving[np.abs(modes) < 30.0]:
        assert np.abs(mapped - mode).min() < 3e-5
    assert np.abs(mapped).max() < 1.0 + 1e-9


def test_secondary_control_must_act_at_knots(quiet_instance, constant):
    case = Case.load(MIXED)
    instance = quiet_instance(case, horizon_s=7.0)
    trajectory = simulate(case, instance, constant(instance, case.p_nominal))
    with pytest.raises(InputError, match="times of secondary control must be among the knots"):
        plant_of(case).linearise_along(trajectory, np.array([0, 200, 300, 700]))
