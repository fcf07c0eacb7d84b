"""The grid of the learned ADMM: loads, power flows, first schedules, linearisation along trajectories."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.methods.admm.modal_grid import MISMATCH, SMALLEST_COST
from ded_bench.methods.admm.problems import POINTS, problems_of, sampled
from ded_bench.methods.stacked_instances import load_segments
from ded_bench.plants.plant import simulate
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from tests.methods.policies import in_operation, modal_grid, started

GRIDS = ("9bus", "two-area", "39bus")


def test_response_is_what_happens(case: Case) -> None:
    """Against the simulation of the nonlinear equations: less than 4 % of the tightest bound."""
    horizon = case.sampling.horizon_s
    grid = modal_grid(case, horizon)
    for instance in (sample_instance(case, POLICY_SEED, 1), in_operation(case, 2, horizon)):
        start = grid.start(problems_of(case, [instance], grid.points))
        _, omega, p_slack = grid.respond(start.schedule, start, grid.along_first(start))
        truth = simulate(case, instance, Schedule(grid.knots, start.schedule[0]))
        points = np.clip(np.round(grid.points / instance.dt_s).astype(int), 0, instance.steps)
        near = np.abs(grid.points - instance.grid[points]) < 1e-3
        assert np.abs(omega[0] - truth.omega[points])[near].max() < 0.04 * grid.bound + 1e-3
        assert np.abs(p_slack[0] - truth.p_slack[points])[near].max() < 0.01


def test_loads_around_kinks_are_means_weighted_by_hats(ninebus: Case) -> None:
    """Against quadrature of the load times the hat function of each grid point."""
    instance, points = sample_instance(ninebus, POLICY_SEED, 3), np.linspace(0.0, 60.0, 197)
    values = sampled(load_segments(ninebus, [instance]), points)[0]
    h = points[1]
    offsets = np.linspace(-h, h, 4001)
    hat = 1.0 - np.abs(offsets) / h
    for k in range(1, len(points) - 1):
        exact = (instance.p_load(ninebus, points[k] + offsets) * hat[:, None]).sum(axis=0) / hat.sum()
        np.testing.assert_allclose(values[k], exact, atol=1e-7)


def test_what_is_drawn_for_training_is_of_both_kinds(case: Case) -> None:
    problems = started(modal_grid(case), 200)[0].problems
    moved = np.abs(problems.delta).max(axis=1) > 0
    assert 0.1 < moved.mean() < 0.5
    assert np.isfinite(problems.load).all()
    if case.schema_ != "ded-bench/case/1":
        assert (problems.load[~moved] * case.load_nominal >= 0).all()


@pytest.mark.parametrize("name", GRIDS)
def test_power_flows_and_stiffness_along_a_trajectory_are_the_networks(name: str) -> None:
    """Angles to the mismatch that is accepted, stiffness by the network's own linearisation."""
    grid = modal_grid(Case.load(name))
    (start, linear), network = started(grid, 2), grid.network
    problems, generators = start.problems, network.generators
    theta = network.power_flow(problems.p_initial[0], problems.load[0, 0])
    np.testing.assert_allclose(start.theta[0], theta, atol=10 * MISMATCH)
    x = (start.schedule[0, -1] - problems.p_initial[0] - start.taken[0, -1]) @ grid.compliance
    last = np.zeros(network.n_bus)
    last[generators] = theta[generators] + x
    ends, injections = network.solve_loads(last, network.load_injections(problems.load[0, -1]))
    for found, angles in ((linear.stiffness[0, 0], theta), (linear.stiffness[0, -1], ends)):
        expected = network.linearise(angles).stiffness
        np.testing.assert_allclose(grid.stiffness + found, expected, rtol=1e-4, atol=1e-4)
    rest = np.linalg.solve(grid.gain.T, -linear.offset[0, -1])  # of the power, what stiffness does not say
    f = rest + (grid.stiffness + linear.stiffness[0, -1]) @ x
    np.testing.assert_allclose(f, injections[generators], atol=10 * MISMATCH)


def test_a_power_flow_without_solution_is_not_served(case: Case) -> None:
    """Powers that no line can carry."""
    grid = modal_grid(case)
    problems = started(grid, 2)[0].problems
    problems.p_initial[1] = 1e3
    np.testing.assert_array_equal(grid.start(problems).served, [True, False])


@pytest.mark.parametrize("name", GRIDS)
def test_costs_are_relative_to_the_static_dispatch(name: str) -> None:
    """Its cost, coarse knot by coarse knot, is that of linear programs; schedules keep bounds and ramps."""
    grid = modal_grid(Case.load(name))
    (start, _), case, every = started(grid, 4), grid.case, grid.coarse.every
    problems, n, reach = start.problems, len(case.generators), np.stack([case.p_min, case.p_max], 1)
    bounds, costs = [*reach, (0.0, None), (0.0, None)], []  # what the slack takes and gives
    for cost, loads in zip(problems.cost, problems.load[:, :: POINTS * every].sum(axis=2), strict=True):
        prices, rows = np.append(cost[1:], [cost[0], cost[0]]), [[1.0] * n + [1.0, -1.0]]
        costs.append(np.mean([linprog(prices, A_eq=rows, b_eq=[-x], bounds=bounds).fun for x in loads]))
    least = SMALLEST_COST * max(1.0, n / 2)
    np.testing.assert_allclose(start.scale, np.maximum(costs, least), rtol=1e-9)
    np.testing.assert_array_equal(start.schedule[:, 0], problems.p_initial)
    assert (np.abs(np.diff(start.schedule, axis=1)) <= grid.ramp + 1e-12).all()
    assert ((start.schedule >= case.p_min) & (start.schedule <= case.p_max))[:, 1:].all()


@pytest.mark.parametrize("name", ["two-area", "39bus"])
def test_first_schedules_are_nearly_the_cheapest_dispatch(name: str) -> None:
    """Where angles turn no faster than the bound lets them: 0.2 % above the linear program."""
    grid = modal_grid(Case.load(name), 60.0)
    (start, _), case, coarse = started(grid, 12), grid.case, grid.coarse
    problems, n, n_gen = start.problems, len(coarse.waves), len(case.generators)
    points = POINTS * coarse.every
    weights, stiffness = np.append(np.ones(n - 1), 0.5) / n, np.kron(np.eye(n), grid.stiffness)
    differences = np.kron(np.eye(n) - np.eye(n, k=-1), np.eye(n_gen))
    shares, none = np.kron(np.eye(n), grid.stiffness.sum(axis=0)), np.zeros((n * n_gen, n))
    found, least = [], []
    for b in range(len(problems)):
        base = problems.p_initial[b] + start.taken[b, ::points]
        short = -problems.load[b, ::points].sum(axis=1) - base.sum(axis=1)
        price, ramps, powers = problems.cost[b], np.diff(base, axis=0).ravel(), base[1:].ravel()
        limits = [
            (stiffness, case.p_max[None] - base[1:], base[1:] - case.p_min[None]),
            (differences @ stiffness, np.tile(coarse.ramp, n) - ramps, np.tile(coarse.ramp, n) + ramps),
            (differences, np.full(n * n_gen, coarse.turn), np.full(n * n_gen, coarse.turn)),
        ]
        rows = [np.hstack([sign * part, none]) for part, *_ in limits for sign in (1.0, -1.0)]
        most = [np.ravel(side) for _, *sides in limits for side in sides]
        rows += [np.hstack([-shares, -np.eye(n)]), np.hstack([shares, -np.eye(n)])]
        cost = np.append(np.kron(weights, price[1:]) @ stiffness, price[0] * weights)
        free = [(None, None)] * (n * n_gen) + [(0.0, None)] * n
        program = linprog(cost, np.vstack(rows), np.concatenate([*most, -short[1:], short[1:]]), bounds=free)
        assert program.status == 0
        constant = float(np.kron(weights, price[1:]) @ powers)
        schedule = start.schedule[b, coarse.every :: coarse.every]
        drawn = -problems.load[b, ::points].sum(axis=1)[1:] - schedule.sum(axis=1)
        found.append(weights @ (schedule @ price[1:] + price[0] * np.abs(drawn)) / start.scale[b])
        least.append((program.fun + constant) / start.scale[b])
    assert np.mean(found) < np.mean(least) + 2e-3


@pytest.mark.parametrize("far", [np.inf, np.nan, 1e300])
def test_a_trajectory_without_end_is_not_served(case: Case, far: float) -> None:
    """A schedule under which the linearised grid swings up: nothing is raised, and the others are served."""
    grid = modal_grid(case)
    start, expected = started(grid, 3)
    assert start.served.all()
    n_flows = (len(grid.knots) - 1) // grid.every + 1
    slow = np.zeros((3, n_flows, len(case.generators)))
    expected = grid.linearise(start, slow)
    slow[1, n_flows // 2 :] = far
    found = grid.linearise(start, slow)
    np.testing.assert_array_equal(start.served, [True, False, True])
    assert all(np.isfinite(values).all() for values in dataclasses.astuple(found))
    np.testing.assert_array_equal(found.offset[[0, 2]], expected.offset[[0, 2]])
