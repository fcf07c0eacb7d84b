"""The scorer: known costs, known violations of each limit, thresholds, and the limit of slow loads."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from ded_bench.plants.score import Score, judge, score
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.sampling import sample_instances
from ded_bench.problem.schedule import Schedule, Trajectory

N = 101


@pytest.fixture
def instance(case, quiet_instance):
    """One second at rest at nominal power, with costs that tell the terms apart."""
    cost = {case.slack: 0.7} | {bus: 0.1 * (j + 2) for j, bus in enumerate(case.generators)}
    return quiet_instance(case, horizon_s=1.0, cost=cost)


@pytest.fixture
def still(case, instance) -> Trajectory:
    """A made-up trajectory that breaks nothing: constant nominal power, P_s = 0.4 pu, ω = 0."""
    n_gen = len(case.generators)
    return Trajectory(
        t=instance.grid,
        omega=np.zeros((N, n_gen)),
        p_set=np.tile(case.p_nominal, (N, 1)),
        p_gen=np.tile(case.p_nominal, (N, 1)),
        p_load=np.tile(case.load_nominal, (N, 1)),
        p_slack=np.full(N, 0.4),
        case=case,
    )


def changed(trajectory: Trajectory, name: str, edit) -> Trajectory:
    """A copy with one array edited in place."""
    array = getattr(trajectory, name).copy()
    edit(array)
    return dataclasses.replace(trajectory, **{name: array})


VIOLATIONS = ("freq_violation_hz", "ramp_violation", "bound_violation", "initial_violation")


def violations(verdict: Score) -> dict[str, float]:
    return {name: getattr(verdict, name) for name in VIOLATIONS if getattr(verdict, name) != 0}


# Hand-made trajectories: exactly one limit is broken, by a known amount.


def test_nothing_broken(case, instance, still):
    """Objective over all points, unscaled, and not a single violation."""
    verdict = judge(case, instance, still, "TO")
    per_point = sum(instance.cost[g] * p for g, p in zip(case.generators, case.p_nominal, strict=True))
    assert verdict.objective == pytest.approx(N * (per_point + 0.7 * 0.4), rel=1e-13)
    assert violations(verdict) == {}
    assert verdict.feasible
    assert verdict.feasible_strict


def test_negative_slack_power_costs_as_much(case, instance, still):
    """c_s |P_s|: exporting through the slack bus is penalised equally."""
    exporting = changed(still, "p_slack", lambda p: np.negative(p, out=p))
    same = judge(case, instance, still, "NO").objective
    assert judge(case, instance, exporting, "NO").objective == same
    half = changed(still, "p_slack", lambda p: p[: N // 2].__imul__(-1))
    assert judge(case, instance, half, "NO").objective == pytest.approx(same, rel=1e-13)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("k", [0, 50, N - 1])
def test_frequency_violation_is_in_hz_beyond_the_bound(case, instance, still, sign, k):
    """One generator at one point, either sign, first and last points included."""
    last = len(case.generators) - 1
    for regime, bound in (("NO", 0.05), ("TO", 0.0016)):

        def push(omega: np.ndarray, bound: float = bound) -> None:
            omega[k, last] = sign * 2 * math.pi * (bound + 0.003)

        verdict = judge(case, instance, changed(still, "omega", push), regime)
        assert violations(verdict) == {"freq_violation_hz": pytest.approx(0.003, rel=1e-9)}
        assert not verdict.feasible

        def touch(omega: np.ndarray, bound: float = bound) -> None:
            omega[k, last] = sign * 2 * math.pi * bound * (1 - 1e-12)

        assert violations(judge(case, instance, changed(still, "omega", touch), regime)) == {}


@pytest.mark.parametrize("sign", [1, -1])
def test_ramp_violation_is_per_step_beyond_epsilon(case, instance, still, sign):
    """A jump of ε + 2e-3 pu between two points; ε = ramp · dt. Up and down alike."""
    epsilon = case.ramp[0] * instance.dt_s

    def jump(p: np.ndarray) -> None:
        p[50:, 0] += sign * (epsilon + 2e-3)

    verdict = judge(case, instance, changed(still, "p_set", jump), "NO")
    assert violations(verdict) == {"ramp_violation": pytest.approx(2e-3, rel=1e-9)}

    def full_ramp(p: np.ndarray) -> None:
        p[:, 0] += sign * epsilon * np.arange(N)

    at_the_limit = judge(case, instance, changed(still, "p_set", full_ramp), "NO")
    assert at_the_limit.ramp_violation < 1e-15
    assert at_the_limit.feasible_strict


@pytest.mark.parametrize("upper", [True, False])
def test_bound_violation_is_the_largest_excess(case, quiet_instance, still, upper):
    """A constant schedule 0.02 pu beyond one limit of the last generator, where it also starts."""
    last = case.generators[-1]
    power = dict(zip(case.generators, case.p_nominal.tolist(), strict=True))
    machine = case.machines[last]
    power[last] = machine.p_max + 0.02 if upper else machine.p_min - 0.02
    omega = dict.fromkeys(case.generators, 0.0)
    outside = quiet_instance(case, horizon_s=1.0, initial={"power": power, "omega": omega})

    def shift(p: np.ndarray) -> None:
        p[:, -1] = power[last]

    verdict = judge(case, outside, changed(still, "p_set", shift), "NO")
    assert violations(verdict) == {"bound_violation": pytest.approx(0.02, rel=1e-9)}


def test_initial_violation_is_the_distance_from_p_0(case, instance, still):
    """A constant schedule 0.01 pu below P_0 of one generator: no ramp, no bound, only the start."""

    def shift(p: np.ndarray) -> None:
        p[:, 0] -= 0.01

    verdict = judge(case, instance, changed(still, "p_set", shift), "NO")
    assert violations(verdict) == {"initial_violation": pytest.approx(0.01, rel=1e-9)}


def test_cost_is_of_what_is_delivered(case, instance, still):
    """Ramps, limits and P_0 are of the set-points, which a plant may follow as it likes."""

    def lag(p: np.ndarray) -> None:
        p[50:] += 0.3

    verdict = judge(case, instance, changed(still, "p_gen", lag), "TO")
    more = 0.3 * (N - 50) * instance.cost_gen(case).sum()
    assert verdict.objective == pytest.approx(judge(case, instance, still, "TO").objective + more, rel=1e-12)
    assert violations(verdict) == {}


# Schedules through the simulator.


def test_slow_loads_approach_static_dispatch(case, quiet_instance):
    """With P = P_opt of the loads at each t_k, the objective exceeds the static one by O(rate).

    The slack bus covers what acceleration and damping take, Σ (M ω' + D ω), and ω is proportional to
    the ramps' rate; the static part of the cost does not depend on the simulation.
    """
    cost = {case.slack: 0.9} | dict.fromkeys(case.generators, 0.2)
    excess = []
    for rate in (4e-3, 2e-3, 1e-3):
        loads = {
            bus: {"initial": value, "start": 1.0, "duration": 1e3, "rate": -rate}
            for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
        }
        p_load = case.load_nominal
        p_opt = merit_order(case, np.full(len(case.generators), 0.2), 0.9, p_load)
        initial = {
            "power": dict(zip(case.generators, p_opt.tolist(), strict=True)),
            "omega": dict.fromkeys(case.generators, 0.0),
        }
        instance = quiet_instance(case, horizon_s=10.0, dt_s=0.05, cost=cost, load=loads, initial=initial)
        p = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), instance.p_load(case))
        verdict = score(case, instance, Schedule(t=instance.grid, p=p), "NO")
        balance = -p.sum(axis=1) - instance.p_load(case).sum(axis=1)
        static = (p @ instance.cost_gen(case) + 0.9 * np.abs(balance)).sum()
        excess.append(abs(verdict.objective / static - 1))
        assert verdict.feasible
        assert verdict.initial_violation < 1e-12
    assert excess[-1] < 1e-3
    np.testing.assert_allclose([excess[0] / excess[1], excess[1] / excess[2]], 2.0, rtol=0.05)


# Thresholds.


@pytest.mark.parametrize("name", VIOLATIONS)
def test_feasible_and_feasible_strict_have_their_thresholds(name):
    """1e-4 Hz and 1e-6 pu; strictly 1e-6 Hz and 1e-8 pu. Each limit alone decides; at the edge: met."""
    loose, strict = (1e-4, 1e-6) if name == "freq_violation_hz" else (1e-6, 1e-8)
    clean = Score(1.0, 0.0, 0.0, 0.0, 0.0)
    for value, feasible, feasible_strict in [
        (0.0, True, True),
        (strict, True, True),
        (np.nextafter(strict, 1), True, False),
        (loose, True, False),
        (np.nextafter(loose, 1), False, False),
        (math.inf, False, False),
        (math.nan, False, False),
    ]:
        verdict = dataclasses.replace(clean, **{name: float(value)})
        assert (verdict.feasible, verdict.feasible_strict) == (feasible, feasible_strict), value


# Refusals.


# Islands.


def test_an_island_is_judged_by_its_mean_frequency_swings_and_end() -> None:
    """Known excess over each bound, peaks, rms and AGC travel; a transfer counts among the limits."""
    case = Case.load("two-area-agc")
    instance = next(sample_instances(case, 1, 1))
    n, weight = instance.steps + 1, case.inertia / case.inertia.sum()
    swing = np.array([1.0, 1.0, -weight[:2].sum() / weight[2], 0.0])  # with a mean of zero
    mean = np.where(np.arange(n) < n - 1, 0.04, 0.01)
    omega = 2 * np.pi * (mean[:, None] + 1e-3 * swing)
    p_set = np.tile(instance.p_initial(case), (n, 1))
    load = instance.p_load(case)
    p_set[:, 0] += 5.5 - case.transfer_excess(p_set, load)[0, 0] - 5.0
    agc = np.repeat([0.0, 0.1, -0.2], [n - 2000, 1000, 1000])
    run = Trajectory(
        t=instance.grid,
        omega=omega,
        p_set=p_set,
        p_gen=p_set + 0.25,
        p_load=load,
        p_slack=np.zeros(n),
        case=case,
        columns={"agc": agc},
    )
    found, limits = judge(case, instance, run, "NO"), case.regimes["NO"]
    largest = 1e-3 * np.abs(swing).max()
    assert found.objective == pytest.approx(((p_set + 0.25) @ instance.cost_gen(case)).sum(), rel=1e-12)
    assert found.excess_mean_hz == found.freq_violation_hz == pytest.approx(0.04 - limits.mean_hz)
    assert found.excess_relative_hz == pytest.approx(max(largest - limits.relative_hz, 0.0), abs=1e-15)
    assert found.excess_end_hz == pytest.approx(0.01 - limits.end_hz)
    assert found.mean_freq_max_hz == pytest.approx(0.04)
    assert found.mean_freq_rms_hz == pytest.approx(0.04, rel=1e-4)
    assert found.swing_max_hz == pytest.approx(largest)
    assert found.swing_rms_hz == pytest.approx(1e-3 * np.sqrt(np.mean(swing**2)))
    assert found.agc_travel_pu == pytest.approx(0.4)
    assert found.bound_violation >= np.max(case.transfer_excess(p_set, load)) > 0.0


@pytest.mark.parametrize(("excess", "feasible"), [(1e-5, True), (np.nextafter(1e-5, 1), False)])
def test_an_island_is_feasible_within_a_tenth_of_the_tolerance(excess: float, feasible: bool) -> None:
    verdict = Score(1.0, float(excess), 0.0, 0.0, 0.0, excess_mean_hz=float(excess))
    assert verdict.feasible == feasible
