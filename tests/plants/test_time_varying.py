"""The linear model along a trajectory: exact to first order, its rows those of its rollout."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from ded_bench.methods import ed
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.plants.time_varying import Delivered, LocalRows, TimeVarying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule, Trajectory

STEPS = 400
#: Knots at unequal distances, as after rounding to the grid.
POINTS = np.array([0, 37, 75, 112, 150, 153, 230, 301, 400])


class Made(NamedTuple):
    """An instance, a schedule on the knots, what it does, and the linear model along that."""

    instance: Instance
    schedule: Schedule
    trajectory: Trajectory
    model: TimeVarying


@pytest.fixture(scope="module")
def made(case: Case) -> Made:
    instance = sample_instance(case, 77, 3).model_copy(update={"horizon_s": STEPS * case.sampling.dt_s})
    times = instance.grid[POINTS]
    schedule = Schedule(t=times, p=ed.dispatch(case, instance, 1.0).at(times))
    trajectory = simulate(case, instance, schedule)
    return Made(instance, schedule, trajectory, plant_of(case).linearise_along(trajectory, POINTS))


def increments(model: TimeVarying) -> Array:
    """Random input increments at the knots, none at the first."""
    u = np.random.default_rng(5).normal(size=model.p_gen.shape)
    u[0] = 0.0
    return u


def test_error_is_of_second_order(case, quiet_instance, constant):
    """Along an equilibrium, against simulations: half the increments, a quarter of the error."""
    instance = quiet_instance(case, horizon_s=STEPS * case.sampling.dt_s)
    trajectory = simulate(case, instance, constant(instance, case.p_nominal))
    model = plant_of(case).linearise_along(trajectory, POINTS)
    u = 0.1 * increments(model)
    errors = []
    for size in (1.0, 0.5, 0.25):
        omega, p_slack = model.outputs(size * u)
        moved = simulate(case, instance, Schedule(t=instance.grid[POINTS], p=model.p_gen + size * u))
        errors.append((np.abs(omega - moved.omega).max(), np.abs(p_slack - moved.p_slack).max()))
    ratio = np.divide(errors[:-1], errors[1:])
    assert ratio == pytest.approx(4.0, rel=0.25)


def test_maps_are_the_matrix_exponential(case, made):
    """Over a step and over an interval, against `expm` of the system with its inputs."""
    network, n, dt = Network(case), len(case.generators), made.instance.dt_s
    for j, length in enumerate(made.model.lengths):
        linear = network.linearise(made.trajectory.states[(POINTS[j] + POINTS[j + 1]) // 2])
        whole = np.zeros((4 * n, 4 * n))  # (δθ, δω, u, slope of u)
        whole[:n, n : 2 * n] = np.eye(n)
        whole[n : 2 * n, :n] = -linear.stiffness / linear.m[:, None]
        whole[n : 2 * n, n : 2 * n] = -np.diag(linear.d / linear.m)
        whole[n : 2 * n, 2 * n : 3 * n] = np.diag(1 / linear.m)
        whole[2 * n : 3 * n, 3 * n :] = np.eye(n)
        for hold, steps in ((made.model.step, 1), (made.model.across, length)):
            exact = expm(whole * dt * steps)[: 2 * n]
            assert hold.f[j] == pytest.approx(exact[:, : 2 * n], abs=1e-12)
            assert hold.g[j] == pytest.approx(exact[:, 2 * n : 3 * n], abs=1e-12)
            assert hold.h[j] * dt == pytest.approx(exact[:, 3 * n :], abs=1e-12)


def test_states_at_knots_are_those_of_the_steps(made):
    """Maps across intervals against the rollout step by step: ω at the knots."""
    u = increments(made.model)
    n_gen = u.shape[1]
    state, states = np.zeros(2 * n_gen), [np.zeros(2 * n_gen)]
    for j, length in enumerate(made.model.lengths):
        slope = (u[j + 1] - u[j]) / length
        for r in range(length):
            f, g, h = (part[j] for part in made.model.step)
            state = f @ state + g @ (u[j] + r * slope) + h @ slope
        states.append(state)
    assert made.model.states(u) == pytest.approx(np.array(states), abs=1e-11)
    omega, _ = made.model.outputs(u)
    expected = made.trajectory.omega[POINTS] + np.array(states)[:, n_gen:]
    assert omega[POINTS] == pytest.approx(expected, abs=1e-11)


def value_of(rows: LocalRows, x: Array, u: Array) -> Array:
    """What rows give with x and u at the ends of their intervals."""
    j = rows.interval
    parts = ((rows.x, x[j]), (rows.start, u[j]), (rows.end, u[j + 1]))
    return sum((row * value).sum(axis=1) for row, value in parts)


def test_rows_are_local_to_their_interval(made):
    """A row gives ω at its point, or its sum of P_s."""
    model, u = made.model, increments(made.model)
    omega, p_slack = model.outputs(u)
    x = model.states(u)
    generators = np.repeat(np.arange(u.shape[1]), 5)
    points = np.tile([1, 37, 38, 152, 399], u.shape[1])
    rows = model.output_rows(generators, points)
    assert value_of(rows, x, u) == pytest.approx((omega - model.omega)[points, generators], abs=1e-10)
    last = model.output_rows(np.arange(u.shape[1]), np.full(u.shape[1], POINTS[-1]))
    assert last.x @ x[-1] == pytest.approx((omega - model.omega)[-1], abs=1e-10)
    assert not last.start.any()
    assert not last.end.any()
    by_set_points = (model.by_set_points(rows) * u).sum(axis=(1, 2))
    assert by_set_points == pytest.approx(value_of(rows, x, u), abs=1e-10)
    first = np.array([0, 20, 37, 75, 112, 150, 151, 153, 230, 301, 350])
    stretches = np.add.reduceat(p_slack - model.p_slack, first)
    assert value_of(model.slack_rows(first), x, u) == pytest.approx(stretches, abs=1e-10)


@pytest.mark.parametrize("every", [1, 2, 3, 100])
def test_rows_are_carried_back_to_earlier_knots(made, every):
    """There they give what they give in the variables of their own intervals; the last knot's, too."""
    model, u = made.model, increments(made.model)
    x, n = model.states(u), len(model.lengths)
    points = np.array([399, 1, 37, 38, 152, POINTS[-1], POINTS[1]])
    rows = model.output_rows(np.zeros(len(points), dtype=int), points)
    first = np.append(np.arange(n) // every * every, n)
    in_state, in_set_points = model.carried_back(rows, first)
    begin = first[rows.interval]
    there = np.array([u[np.minimum(k + np.arange(in_set_points.shape[1]), n)] for k in begin])
    found = (in_state * x[begin]).sum(axis=1) + (in_set_points * there).sum(axis=(1, 2))
    omega, _ = model.outputs(u)
    assert found == pytest.approx((omega - model.omega)[points, 0], abs=1e-10)
    beyond = begin[:, None] + np.arange(in_set_points.shape[1]) > np.minimum(rows.interval + 1, n)[:, None]
    assert not in_set_points[beyond].any()


def test_cost_rows_sum_what_is_delivered(made):
    """Cost · (C_p δx + D_p u), summed point by point; the last point is the last interval's."""
    model, rng, n_gen = made.model, np.random.default_rng(7), made.model.p_gen.shape[1]
    c = rng.normal(size=(len(model.lengths), n_gen, 2 * n_gen))
    d, cost = rng.normal(size=(len(model.lengths), n_gen, n_gen)), rng.uniform(size=n_gen)
    given = dataclasses.replace(model, delivered=Delivered(c, d, np.zeros((STEPS + 1, n_gen))))
    u, expected = increments(model), np.zeros(len(model.lengths))
    x = model.states(u)
    for j, length in enumerate(model.lengths):
        state, slope = x[j], (u[j + 1] - u[j]) / length
        for r in range(length + (j == len(model.lengths) - 1)):
            expected[j] += cost @ (c[j] @ state + d[j] @ (u[j] + r * slope))
            f, g, h = (part[j] for part in model.step)
            state = f @ state + g @ (u[j] + r * slope) + h @ slope
    assert value_of(given.cost_rows(cost), x, u) == pytest.approx(expected, rel=1e-9, abs=1e-9)
