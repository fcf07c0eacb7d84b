"""Learned ADMM on islands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.files.errors import InputError
from ded_bench.methods.ed import static_dispatch, within_ramps
from ded_bench.methods.island.block_factors import solve
from ded_bench.methods.island.island_iterations import (
    FORGOTTEN,
    RAMP_MARGIN,
    REGULARISATION,
    RESOLUTION,
    Found,
    IslandGrid,
    IslandIterations,
    IslandProblem,
    swings_by,
)
from ded_bench.methods.island.island_policy import IslandPolicy, IslandSolver
from ded_bench.methods.island.island_training import FIRST, train
from ded_bench.methods.knots import knot_points
from ded_bench.methods.registry import get_method, trainable
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.trained_policy import Scope
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from tests.methods.test_on_island import followed

HORIZON = 8.0


def policy(case: Case, settings: Any = FIRST, regime: str = "TO", quick: bool = True) -> IslandPolicy:
    facts = {"rounds": 2, "iterations": 15, "mending": 6, "quick": quick}
    return IslandPolicy(Scope(case, regime, HORIZON), {"settings": np.float32(settings)}, facts)


def test_many_iterations_solve_the_linear_program(island: Case, instance: Instance) -> None:
    """HiGHS on the same rows; single precision and a thousand iterations leave a thousandth of the gain."""
    grid = IslandGrid(island, "TO", HORIZON)
    asked = grid.ask(instance)
    near = grid.follow(asked, asked.start)
    iterate = IslandIterations(grid, np.log([1.0, 1.0, 1.0, 1.0, 10.0]))
    found, _ = iterate(asked, near, 1500, np.array([0.3, 0.1]))
    n, n_gen = grid.maps.mean.shape[1], len(island.generators)
    swings = [swings_by(grid.maps, np.float32(one).reshape(-1, n_gen)).ravel() for one in np.eye(n)]
    rows = np.vstack([grid.maps.mean, np.transpose(swings)])
    room = np.repeat([0.7, 0.9], [len(near.mean), near.swings.size])
    room[len(near.mean) - 1] *= grid.last
    x0, at = near.schedule[1:].ravel(), np.concatenate([near.mean, near.swings.ravel()])
    change = np.eye(n) - np.eye(n, k=-n_gen)
    reach = (1.0 - RAMP_MARGIN) * np.tile(grid.step, n // n_gen)
    first = np.concatenate([asked.p_initial, np.zeros(n - n_gen)])
    free = at - rows @ x0
    most = np.concatenate([room - free, room + free, reach + first, reach - first])
    cost = asked.cost @ grid.delivered
    limits = list(zip(np.tile(island.p_min, n // n_gen), np.tile(island.p_max, n // n_gen), strict=True))
    best = linprog(cost, A_ub=np.vstack([rows, -rows, change, -change]), b_ub=most, bounds=limits)
    assert best.status == 0
    gain = cost @ x0 - best.fun
    assert gain > 0.0
    assert abs(cost @ found[1:].ravel() - best.fun) < 0.02 * gain
    outputs = at + rows @ (found[1:].ravel() - x0)
    assert (np.abs(outputs) < room + 0.01).all()


def test_rows_are_the_linear_answer(island: Case) -> None:
    """Those of the coarse plant; swings are forgotten once little of them remains."""
    grid = IslandGrid(island, "TO", HORIZON)
    change = np.zeros((len(grid.knots), len(island.generators)))
    change[1:4, 0], change[2, 1] = (0.02, 0.03, 0.01), -0.04
    omega, _ = grid.coarse.response((grid.hat @ change)[:, :, None], agc=False)
    swings = omega[1:, :, 0] @ grid.outputs[1:].T
    found = swings_by(grid.maps, np.float32(change[1:])).reshape(swings.shape)
    assert np.abs(found - swings).max() < 2.0 * FORGOTTEN * np.abs(swings).max()
    omega, _ = grid.coarse.response((grid.hat @ change)[:, :, None])
    mean = (omega[:, :, 0] @ grid.outputs[0])[grid.between :: grid.between]
    np.testing.assert_allclose(grid.maps.mean @ np.float32(change[1:].ravel()), mean, atol=1e-4)


def test_substeps_are_of_second_order(island: Case, instance: Instance) -> None:
    """Rows stand where they stood; the error of their simulation falls to a quarter with every halving."""
    grids = [IslandGrid(island, "TO", HORIZON, substeps) for substeps in (1, 2, 4, 8)]
    start = grids[0].ask(instance).start
    *found, exact = (np.append(f.mean, f.swings) for f in (g.follow(g.ask(instance), start) for g in grids))
    errors = [np.linalg.norm(one - exact) for one in found]
    assert errors[0] > 2.5 * errors[1] > 6.0 * errors[2] > 0.0
    for own, finer in zip(grids[0].maps, grids[1].maps, strict=True):
        np.testing.assert_allclose(own, finer, rtol=0, atol=1e-5 * np.abs(own).max())


def test_the_factored_inverse_is_that_of_all_rows(island: Case) -> None:
    """Squares of all rows times their penalties, summed; single precision."""
    grid = IslandGrid(island, "TO", HORIZON)
    mean, swing, limit, ramp = penalties = (0.2, 0.25, 2.5, 0.2)
    made = IslandIterations(grid, np.log([*penalties, 20.0]))
    n, n_gen = grid.maps.mean.shape[1], len(island.generators)
    swings = [swings_by(grid.maps, np.float32(one).reshape(-1, n_gen)).ravel() for one in np.eye(n)]
    ramps = (np.eye(n) - np.eye(n, k=-n_gen)) / np.tile(grid.step, n // n_gen)[:, None]
    transfers = np.kron(np.eye(n // n_gen), island.transfer_rows[0])
    kinds = [(mean, grid.maps.mean), (swing, np.transpose(swings)), (ramp, ramps), (limit, transfers)]
    squares = sum(weight * np.float64(rows).T @ rows for weight, rows in kinds)
    squares += (limit + REGULARISATION) * np.eye(n)
    right = np.random.default_rng(0).normal(size=n).astype(np.float32)
    wanted = np.linalg.solve(squares, right)
    np.testing.assert_allclose(solve(made.factors, right), wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())
    np.testing.assert_allclose(made.pull, np.linalg.solve(squares, grid.delivered.T), rtol=1e-4, atol=1e-7)


def test_what_is_not_simulated_is_the_linear_answer(island: Case, instance: Instance) -> None:
    """Of a small change, to a twentieth of what it does: that is what a step of the simulation errs by."""
    grid = IslandGrid(island, "TO", HORIZON)
    asked = grid.ask(instance)
    near = grid.follow(asked, asked.start)
    change = np.zeros_like(near.schedule)
    change[2:5, 0] = 1e-3
    moved, true = grid.moved(near, near.schedule + change), grid.follow(asked, near.schedule + change)
    for kind in ("mean", "swings"):
        before, said, found = (getattr(one, kind) for one in (near, moved, true))
        assert np.abs(said - found).max() < 0.05 * np.abs(found - before).max()
    assert abs(moved.excess - true.excess) < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_limits_hold_for_any_settings(island: Case, instance: Instance, seed: int) -> None:
    settings = np.random.default_rng(seed).normal(size=len(FIRST))
    powers = policy(island, settings).powers(instance)
    found = score(island, instance, Schedule(island.knot_times(HORIZON), powers), "TO")
    assert max(found.ramp_violation, found.bound_violation, found.initial_violation) <= 1e-8


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_a_trained_policy_keeps_the_bounds(
    island: Case, instance: Instance, regime: str, tmp_path: Path
) -> None:
    """What a file holds is what was trained; its answers are feasible, and near the optimum."""
    out = tmp_path / f"ded-admm-{regime}.safetensors"
    made = train(island, regime, [instance] * 2, out, TrainingOptions(epochs=1))
    assert out.with_suffix(".history.csv").is_file()
    solve = get_method("ded-admm").prepare(island, regime, Settings(policy=out))
    schedule = solve(instance).schedule
    assert schedule is not None
    np.testing.assert_array_equal(schedule.p, made.powers(instance))
    found = score(island, instance, schedule, regime)
    assert found.feasible
    best = get_method("ded-slp").prepare(island, regime, Settings())(instance).solver_objective
    assert found.objective < 1.005 * best


def test_no_other_policy_is_trained_by_default(island: Case) -> None:
    assert "ded-admm" in trainable(island)
    assert not [name for name in trainable(island) if get_method(name).lossless]


def test_one_instance_is_too_few_to_train_on(island: Case, instance: Instance, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="too few"):
        train(island, "TO", [instance], tmp_path / "p.safetensors", TrainingOptions(epochs=1))


@pytest.mark.parametrize("quick", [False, True])
def test_further_iterations_are_no_dearer(island: Case, instance: Instance, quick: bool) -> None:
    made = policy(island, quick=quick)
    own, further = (Schedule(made.knots, made.powers(instance, count)) for count in (0, 60))
    cost, more = (score(island, instance, one, "TO") for one in (own, further))
    assert more.feasible
    assert more.objective <= cost.objective * (1.0 + 1e-5)


def test_plans_in_operation_begin_with_the_plants_own_state(island: Case, instance: Instance) -> None:
    """Near the plan in force, and from the true state to their resolution; else from what is measured."""
    made = policy(island)
    solver = IslandSolver(made, 0)
    first = solver.solve(instance).schedule
    assert first is not None
    np.testing.assert_array_equal(first.p, made.powers(instance))
    true, later, in_force = followed(island, instance, first)
    plan = solver.solve(later, Solution(Status.FEASIBLE, in_force)).schedule
    assert plan is not None
    known = made.powers(later, state=true, last=in_force)
    np.testing.assert_allclose(plan.p, known, rtol=0, atol=2 * RESOLUTION)
    assert np.abs(plan.p - made.powers(later, last=in_force)).max() > 100 * RESOLUTION


@pytest.mark.parametrize("bad", [False, True])
def test_warm_starts_take_one_round_unless_they_lead_far_beyond(
    bad: bool, island: Case, instance: Instance, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a good answer, and from one that seems to be beyond a bound by twice as much: then anew."""
    made, calls = policy(island), []
    answer, improved = made.powers(instance), made._improved

    def counted(
        asked: IslandProblem, first: Found | None, count: int, rounds: int | None = None
    ) -> Found | None:
        calls.append(rounds)
        found = improved(asked, first, count, rounds)
        return replace(found, excess=2.0) if found is not None and bad and rounds else found

    monkeypatch.setattr(IslandPolicy, "_improved", lambda _, *asked, **rounds: counted(*asked, **rounds))
    found = made.powers(instance, last=Schedule(made.knots, answer))
    assert calls == ([1, None] if bad else [1])
    assert np.array_equal(found, answer) == bad
    assert score(island, instance, Schedule(made.knots, found), "TO").feasible


@pytest.mark.parametrize("carried", [0, 3])
def test_a_start_that_the_plant_cannot_carry(
    carried: int, island: Case, instance: Instance, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then it goes on from the static dispatch; where nothing else is carried, that is the answer."""
    made = policy(island)
    follow, starts, seen = made.grid.follow, [], []

    def refusing(asked: IslandProblem, schedule: np.ndarray, linear: bool = False) -> Found:
        if linear:
            starts.append(schedule)
            return follow(asked, schedule, linear)
        if len(starts) == 1 or len(seen) == carried:
            raise SimulationError("no voltages")
        seen.append(schedule)
        return follow(asked, schedule)

    monkeypatch.setattr(made.grid, "follow", refusing)
    answer = made.powers(instance)
    served = within_ramps(
        island,
        instance,
        static_dispatch(island, instance, lead=False),
        knot_points(made.knots, instance.dt_s),
    )
    np.testing.assert_array_equal(starts[1], served)
    assert np.array_equal(answer, served) == (carried == 0)
