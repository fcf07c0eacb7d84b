"""What room for ramps that nobody announced costs any controller that keeps the bound for sure: a reference.

A controller that knows everything but such ramps, and is told of each when it begins, still has to be able to
follow it. While the ramp lasts, angles move by the bound times its duration τ at most; what the load moves
them beyond that, generators have to take back, so that at every instant at which the ramp may begin there are
movements v within the generators' limits with

    |K (v - T λ τ)| <= ω_bnd τ,    p_min <= P + v <= p_max,    |v| <= τ ramp

for the steepest and longest ramp λ, τ of each load, up and down, that its range allows (K and T as in
`methods/reserve.py`). The static dispatch of every second with that room is compared with the one without.

It is a reference, not a bound that is proven for the plant: the network is linear at the nominal point, the
momentum at the end of a ramp is left out, costs are those of the static dispatch, and no excess is allowed.
It may begin always, for who knows no law; or in stretches of a horizon whose ramp is not announced, until it
begins, for who knows the law of scenarios.

    python studies/causal_reference.py CASE COUNT
"""

from __future__ import annotations

import sys

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from ded_bench import Case
from ded_bench.methods.reserve import steady_speeds
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array
from ded_bench.problem.sampling import LOAD_RANGE, sample_scenario
from ded_bench.problem.scenario import Scenario

SEED, EVERY_S, REGIME = 4_400_000, 2.0, "TO"


def due(case: Case, scenario: Scenario, t: float) -> Array:
    """Whether a ramp of each load may begin that nobody announced, (n_load,)."""
    first = np.floor(t / case.sampling.horizon_s) * case.sampling.horizon_s
    found = []
    for bus in case.loads:
        ramps = [r for r in scenario.load[bus].ramps if first <= r.start < first + case.sampling.horizon_s]
        found.append(any(r.announced_start is None and r.start > t for r in ramps))
    return np.array(found)


def cost(
    case: Case,
    grid: tuple[Array, Array],
    scenario: Scenario,
    load: Array,
    surprises: list[tuple[int, float]],
) -> float:
    """Least cost of an instant's dispatch with room for surprises: load, and how far it may move, pu."""
    n = len(case.generators)
    prices = np.array([scenario.cost[bus] for bus in case.generators])
    bound, (by_load, compliance) = case.omega_bound(REGIME), grid
    steepest = np.abs(case.load_rate).max(axis=0)
    objective = [prices, [scenario.cost[case.slack]]]
    rows, right, limits = [], [], [*zip(case.p_min, case.p_max, strict=True), (0.0, None)]
    width = n + 1 + n * len(surprises)
    for sign in (1.0, -1.0):  # |P_s|
        row = np.zeros(width)
        row[:n], row[n] = -sign, -1.0
        rows.append(row[None])
        right.append([sign * load.sum()])
    for number, (bus, moved) in enumerate(surprises):
        at = slice(n + 1 + n * number, n + 1 + n * (number + 1))
        lasts = abs(moved) / steepest[bus]
        alone = by_load[bus] * moved  # what the load alone does to angles
        for sign in (1.0, -1.0):
            block = np.zeros((2 * n, width))
            block[:n, at] = sign * compliance
            block[n:, :n], block[n:, at] = sign * np.eye(n), sign * np.eye(n)
            rows.append(block)
            ends = case.p_max if sign > 0 else -case.p_min
            right.append([*(bound * lasts - sign * alone), *ends])
        limits += [(-r * lasts, r * lasts) for r in case.ramp]
        objective.append(np.zeros(n))
    found = linprog(
        np.concatenate(objective), sp.csr_matrix(np.vstack(rows)), np.concatenate(right), bounds=limits
    )
    return float(found.fun) if found.status == 0 else np.nan


def main(name: str, count: str) -> None:
    """Print means over scenarios with 95 % confidence intervals."""
    case = Case.load(name)
    grid, longest = steady_speeds(case), case.sampling.duration_s[1]
    speeds = np.abs(case.load_rate).max(axis=0) * np.abs(grid[0]).max(axis=1)
    fast = np.flatnonzero(speeds > case.omega_bound(REGIME))
    increases = []
    for index in range(int(count)):
        scenario = sample_scenario(case, SEED, index, servable)
        times = np.arange(0.0, scenario.duration_s, EVERY_S)
        total = np.zeros(3)
        for t, load in zip(times, scenario.p_load(case, times), strict=True):
            most = np.abs(case.load_rate).max(axis=0) * longest
            room = LOAD_RANGE * np.abs(case.load_nominal)
            moves = [
                (int(i), sign * min(most[i], max(room[i] - sign * (load[i] - case.load_nominal[i]), 0.0)))
                for i in fast
                for sign in (1.0, -1.0)
            ]
            may = due(case, scenario, t)
            plain = cost(case, grid, scenario, load, [])
            now = [move for move in moves if may[move[0]]]
            known = cost(case, grid, scenario, load, now) if now else plain
            total += plain, known, cost(case, grid, scenario, load, moves) if moves else plain
        increases.append(100 * (total[1:] / total[0] - 1))
    mean, half = np.mean(increases, axis=0), 1.96 * np.std(increases, axis=0, ddof=1) / np.sqrt(int(count))
    print(f"{name}, {count} scenarios, loads of which a ramp is too fast: {[case.loads[i] for i in fast]}")
    for who, m, h in zip(("knows the law", "knows no law"), mean, half, strict=True):
        print(f"{who}: {m:.3f} ± {h:.3f} % of the static dispatch")


if __name__ == "__main__":
    main(*sys.argv[1:3])
