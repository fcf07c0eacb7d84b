"""Elimination, power flows and first schedules of the shared policy, compiled; against NumPy and the case."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.methods.admm.elimination import plan_elimination
from ded_bench.methods.admm.grid_response import FINE
from ded_bench.methods.admm.iteration_records import SMALLEST_COST
from ded_bench.methods.admm.path_kernels import MISMATCH, follow_path, start_angles
from ded_bench.methods.admm.admm_training import LOOSE, TIGHT, iterations_of
from ded_bench.problem.case import Case
from tests.methods.test_dpc_shared import drawn, path_model

GRIDS = ("9bus", "two-area", "39bus")


def test_elimination_of_a_ring_makes_its_mesh_lines() -> None:
    """Four buses in a ring, one kept: each elimination leaves a smaller ring, and no line twice."""
    ends = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 1]])  # two lines in parallel
    plan = plan_elimination(ends, 4, [3])
    assert set(plan.buses.tolist()) == {0, 1, 2}
    edges = [
        {bus, int(other)}
        for bus, first, last in zip(plan.buses.tolist(), plan.first[:-1], plan.first[1:], strict=True)
        for other in plan.neighbours[first:last]
    ]
    assert len(edges) == len({frozenset(edge) for edge in edges}) == 5  # four of the ring and one mesh line
    assert [edges[e] for e in plan.of_line] == [set(line) for line in ends.tolist()]


@pytest.mark.parametrize("name", GRIDS)
def test_power_flows_and_stiffness_along_a_path_are_the_networks(name: str) -> None:
    """Angles to the mismatch that is accepted, stiffness by the network's own, dense, linearisation."""
    model = path_model(Case.load(name))
    outset, network = drawn(model, 2), model.network
    problems, generators = outset.problems, network.generators
    path = outset.theta[0, generators] + model.start_path(outset)[0]
    loads = np.ascontiguousarray(problems.load[0, :: model.response.every * FINE])
    f, stiffness = np.empty_like(path), np.empty((2, len(generators), len(generators)))
    instants = np.array([0, len(path) - 1])
    place = outset.theta[0], instants
    assert follow_path(model.lines, model.to_machines, path, loads, *place, f, stiffness)
    theta = network.power_flow(problems.p_initial[0], loads[0])
    np.testing.assert_allclose(outset.theta[0], theta, atol=10 * MISMATCH)
    last = np.zeros(network.n_bus)
    last[generators] = path[-1]
    ends, injections = network.solve_loads(last, network.load_injections(loads[-1]))
    np.testing.assert_allclose(f[-1], injections[generators], atol=10 * MISMATCH)
    for found, angles in zip(stiffness, (theta, ends), strict=True):
        np.testing.assert_allclose(found, network.linearise(angles).stiffness, rtol=1e-4, atol=1e-4)


def test_a_power_flow_without_solution_is_not_served(case: Case) -> None:
    """Powers that no line can carry."""
    model = path_model(case)
    wanted, theta = np.full(model.network.n_bus, 1e3), np.empty(model.network.n_bus)
    assert not start_angles(model.lines, model.to_slack, model.response.theta, wanted, theta)


@pytest.mark.parametrize("name", GRIDS)
def test_first_schedules_follow_a_dispatch_within_ramps(name: str) -> None:
    """Its cost, knot by knot, is that of linear programs; schedules start at P_0, keep bounds and ramps."""
    model = path_model(Case.load(name))
    outset, case = drawn(model, 4), model.case
    problems, n = outset.problems, len(case.generators)
    costs = []
    for cost, before, loads in zip(problems.cost, problems.p_initial, problems.load[:, ::FINE], strict=True):
        prices, found = np.append(cost[1:], [cost[0], cost[0]]), []
        for j, load in enumerate(loads.sum(axis=1)):
            step = np.zeros(n) if j == 0 else model.ramp
            reach = np.stack(
                [np.maximum(case.p_min, before - step), np.minimum(case.p_max, before + step)], 1
            )
            slack = [(0.0, None), (0.0, None)]  # what the slack takes and gives
            program = linprog(prices, A_eq=[[1.0] * n + [1.0, -1.0]], b_eq=[-load], bounds=[*reach, *slack])
            before = program.x[:n]
            found.append(program.fun)
        costs.append(np.mean(found))
    least = SMALLEST_COST * max(1.0, n / 2)
    np.testing.assert_allclose(outset.scale, np.maximum(costs, least), rtol=1e-9)
    np.testing.assert_array_equal(outset.start[:, 0], problems.p_initial)
    assert (np.abs(np.diff(outset.start, axis=1)) <= model.ramp + 1e-12).all()
    assert ((outset.start >= case.p_min) & (outset.start <= case.p_max))[:, 1:].all()


def test_iterations_by_size_and_bound() -> None:
    """Fewer on large grids, and where the bound is loose."""
    found = {}
    for name in ("9bus", "39bus"):
        case = Case.load(name)
        for regime in case.regimes:
            model = path_model(case)
            model.bound = case.omega_bound(regime)
            found[name, regime] = iterations_of(model)
    assert found["39bus", "TO"] == TIGHT[0] > found["39bus", "NO"] == LOOSE[0]
    assert found["9bus", "TO"] == TIGHT[1] // 2 > found["9bus", "NO"] == LOOSE[1] // 2
