"""Reserve: speeds under ramps, room that plans keep, and grids that need none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from ded_bench.methods import real_time_reserve
from ded_bench.methods.real_time_reserve import AHEAD_S, LIMIT
from ded_bench.methods.registry import get_method
from ded_bench.methods.reserve import Reserve
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.plants.lossless.network import Network


def answered(case: Case, instance: Instance, settings: str, regime: str, model: str) -> Schedule:
    solver = get_method("ded-ko-knots").prepare(case, regime, Settings(settings, model=model))
    solution = solver(instance)
    assert solution.status == Status.FEASIBLE
    return solution.schedule


def shortage(reserve: Reserve, power: Array) -> float:
    """The least e with which every ramp can be followed from some powers, rad/s, one ramp after another."""
    case, worst = reserve.case, 0.0
    n = len(power)
    for alone in reserve.speeds:
        rows = np.block([[reserve.compliance, -np.ones((n, 1))], [-reserve.compliance, -np.ones((n, 1))]])
        room = [
            (max(-r, (low - p) / reserve.duration_s), min(r, (high - p) / reserve.duration_s))
            for r, p, low, high in zip(case.ramp, power, case.p_min, case.p_max, strict=True)
        ]
        found = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=rows,
            b_ub=np.concatenate([reserve.limit - alone, reserve.limit + alone]),
            bounds=[*room, (0.0, None)],
        )
        assert found.status == 0
        worst = max(worst, found.fun)
    return worst


def test_speeds_are_those_of_the_power_flow(case: Case) -> None:
    """A load that ramps slowly takes the angles from one equilibrium to the next."""
    reserve, network, tiny = Reserve.of(case, 0.0), Network(case), 1e-5
    n_loads = len(case.loads)
    assert reserve.speeds.shape == (2 * n_loads, len(case.generators))
    for i in range(n_loads):
        change = tiny * np.eye(n_loads)[i] * np.abs(case.load_rate[:, i]).max()
        ends = [
            network.power_flow(case.p_nominal, case.load_nominal + sign * change)[network.generators]
            for sign in (-0.5, 0.5)
        ]
        # What is left of the central difference is of second order, and the digits of the power flow.
        expected = (ends[1] - ends[0]) / tiny
        assert np.allclose(-reserve.speeds[i], expected, rtol=1e-5, atol=1e-6)
        assert np.array_equal(reserve.speeds[n_loads + i], -reserve.speeds[i])


@pytest.mark.parametrize("index", [0, 1])
def test_plans_keep_room_for_the_steepest_ramps(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where plans without reserve have generators at their limits; an independent solver says how short."""
    monkeypatch.setattr(real_time_reserve, "PRICE", 20.0)  # above all that room can cost
    case = Case.load("two-area")
    instance = sample_instance(case, VALIDATION_SEED, index)
    reserve = Reserve.of(case, LIMIT * case.omega_bound("TO"))
    assert len(reserve.speeds) == 4  # both loads, up and down
    worst = {}
    for settings in ("real-time", "reserve"):
        schedule = answered(case, instance, settings, "TO", "trajectory")
        # The first seconds lead from P_0 to where there is room.
        chosen = (schedule.t > 10.0) & (schedule.t < AHEAD_S)
        worst[settings] = max(shortage(reserve, power) for power in schedule.p[chosen])
    assert worst["real-time"] > 0.1 * reserve.limit
    # Programs stop at residuals of 1e-5, in rad/s and pu.
    assert worst["reserve"] < 1e-3 * reserve.limit


def test_where_no_ramp_is_fast_plans_are_the_same(ninebus: Case) -> None:
    assert len(Reserve.of(ninebus, LIMIT * ninebus.omega_bound("NO")).speeds) == 0
    instance = sample_instance(ninebus, VALIDATION_SEED, 0)
    plain, with_reserve = (
        answered(ninebus, instance, settings, "NO", "linear") for settings in ("real-time", "reserve")
    )
    assert np.array_equal(plain.p, with_reserve.p)
