"""A lower bound on the cost of any controller that keeps the bound and learns of a ramp when it begins.

By information relaxation: a controller that is told more can only do better. Of a drawn scenario of 60 s the
ramp of one load is not announced. Its start is uniform in the 60 s; it is told at the start of the part of
PART_S in which it begins, with its duration and its rate, drawn anew for every part and either direction. All
else of the scenario is known from t = 0. So what is planned is a tree: a trunk, on which the ramp has not
begun, and two branches from every part of it. One linear program over the tree has the least expected cost;
hindsight is the mean of the programs over single branches, each from its own t = 0.

The grid is linear at the nominal point, |ω| keeps its bound at knots and halfway between, and beyond BRANCH_S
from its begin a branch costs no less than the dispatch that knows no dynamics. Each of these lets the
controller pay less. Loads are linear between knots.

    python studies/causal_bound.py CASE COUNT [LOAD,LOAD]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import highspy
import numpy as np
import scipy.linalg
import scipy.sparse as sp

from ded_bench import Case
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import servable
from ded_bench.problem.case import Array
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.sampling import sample_scenario
from ded_bench.problem.scenario import Scenario
from ded_bench.solvers.linear_program import FreeForm

SEED, REGIME, DURATION_S = 4_600_000, "TO", 60.0
#: Distance of knots, length of parts in which a start is told, how long a branch is planned, s.
KNOT_S, PART_S, BRANCH_S = 0.5, 4.0, 15.0


@dataclass
class Tree:
    """Knots of a plan: what stands before each, when it is, loads there, and how much its costs count."""

    before: list[int] = field(default_factory=list)  # -1: the first
    load: list[Array] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)

    def add(self, before: int, load: Array, weight: float) -> int:
        """Add a knot; returns its number."""
        self.before.append(before)
        self.load.append(load)
        self.weight.append(weight)
        return len(self.before) - 1


def held(a: Array, b: Array, h: float) -> tuple[Array, Array, Array]:
    """State after h of x' = a x + b u from the state, the input at the start, and its slope (per s)."""
    n, m = b.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m], block[n : n + m, n + m :] = a, b, np.eye(m)
    found = scipy.linalg.expm(block * h)
    return found[:n, :n], found[:n, n : n + m], found[:n, n + m :]


class Grid:
    """The linearised grid between two knots."""

    def __init__(self, case: Case) -> None:
        network = Network(case)
        theta = network.power_flow(case.p_nominal, case.load_nominal)
        linear = network.linearise(theta)
        self.case, self.n = case, len(case.generators)
        self.linear, n = linear, self.n
        nothing, one = np.zeros((n, n)), np.eye(n)
        a = np.block([[nothing, one], [-linear.stiffness / linear.m[:, None], -np.diag(linear.d / linear.m)]])
        b = np.vstack([nothing, np.diag(1.0 / linear.m)])
        self.half, self.whole = (held(a, b, h) for h in (KNOT_S / 2, KNOT_S))

    def least_cost(self, scenario: Scenario, tree: Tree) -> float | None:
        """Least expected cost over a tree, per knot; None: nothing keeps the bound.

        Columns of each knot: δ and ω (from nominal), P, and the slack's |P_s|.
        """
        case, n, linear = self.case, self.n, self.linear
        count, width = len(tree.before), 3 * n + 1
        cost_gen = np.array([scenario.cost[bus] for bus in case.generators])
        bound, load = case.omega_bound(REGIME), np.array(tree.load)
        drawn = (load - case.load_nominal) @ linear.share.T  # what loads take at generators
        power = np.array([scenario.initial.power[bus] for bus in case.generators])
        first = np.linalg.solve(linear.stiffness, power - case.p_nominal - drawn[0])
        lower = np.tile(
            np.concatenate([np.full(n, -np.inf), np.full(n, -bound), case.p_min, [0.0]]), (count, 1)
        )
        upper = np.tile(
            np.concatenate([np.full(n, np.inf), np.full(n, bound), case.p_max, [np.inf]]), (count, 1)
        )
        start = np.concatenate([first, [scenario.initial.omega[bus] for bus in case.generators], power])
        lower[0, :-1] = upper[0, :-1] = start
        cost = np.array(tree.weight)[:, None] * np.concatenate(
            [np.zeros(2 * n), cost_gen, [scenario.cost[case.slack]]]
        )
        at = np.arange(count * width).reshape(count, width)
        x, p, s = at[:, : 2 * n], at[:, 2 * n : 3 * n], at[:, -1]
        now, then = np.array(tree.before[1:]), np.arange(1, count)
        force = drawn + case.p_nominal  # of which P is the other side

        def rows(blocks: list[tuple[Array, Array]], height: int) -> sp.csc_matrix:
            """One block of rows for each of several knots; (knots, columns) and (height, columns)."""
            k = len(blocks[0][0])
            row = np.arange(k * height).reshape(k, height)
            parts = [
                (np.broadcast_to(m, (k, *m.shape)), np.broadcast_to(row[:, :, None], (k, *m.shape)), c)
                for c, m in blocks
            ]
            values = np.concatenate([v.ravel() for v, *_ in parts])
            at_row = np.concatenate([r.ravel() for _, r, _ in parts])
            columns = np.concatenate([np.broadcast_to(c[:, None, :], v.shape).ravel() for v, _, c in parts])
            return sp.csc_matrix((values, (at_row, columns)), (k * height, count * width))

        def moved(part: tuple[Array, Array, Array]) -> tuple[list[tuple[Array, Array]], Array]:
            """The state after a part of an interval: by columns, and what is not."""
            by_state, by_start, by_slope = part
            slope = by_slope / KNOT_S
            given = force[now] @ (by_start - slope).T + force[then] @ slope.T
            return [(x[now], by_state), (p[now], by_start - slope), (p[then], slope)], -given

        by_columns, given = moved(self.whole)
        equal = rows([(x[then], -np.eye(2 * n)), *by_columns], 2 * n)
        middle, given_middle = moved(self.half)
        between = [rows([(c, m[n:]) for c, m in middle], n)]
        low, high = [-bound - given_middle[:, n:]], [bound - given_middle[:, n:]]
        one = np.eye(n)
        between.append(rows([(p[then], one), (p[now], -one)], n))
        step = np.tile(case.ramp * KNOT_S, (count - 1, 1))
        low.append(-step)
        high.append(step)
        # P_s = -Σ f - Σ L, with f = P_nominal + S δ + T (L - L_nominal)
        taken = -(force.sum(axis=1) + load.sum(axis=1))
        sums = np.concatenate([-linear.stiffness.sum(axis=0), np.zeros(n)])[None]
        for sign in (1.0, -1.0):
            between.append(rows([(x, sign * sums), (s[:, None], -np.ones((1, 1)))], 1))
            low.append(np.full((count, 1), -np.inf))
            high.append(-sign * taken[:, None])
        form = FreeForm(
            cost=cost.ravel(),
            equal=equal,
            right=-given.ravel(),
            between=sp.csc_matrix(sp.vstack(between)),
            low=np.concatenate([a.ravel() for a in low]),
            high=np.concatenate([a.ravel() for a in high]),
            lower=lower.ravel(),
            upper=upper.ravel(),
        )
        return interior_point(form)


def interior_point(form: FreeForm) -> float | None:
    """The least cost by HiGHS's interior points, which a tree costs a tenth of what simplex steps do."""
    highs = highspy.Highs()
    for name, value in {"output_flag": False, "threads": 1, "solver": "ipm", "run_crossover": "off"}.items():
        highs.setOptionValue(name, value)
    rows, low, high = form.all_rows()
    (m, n), bounds, matrix = (
        rows.shape,
        (form.lower, form.upper, low, high),
        (rows.indptr, rows.indices, rows.data),
    )
    highs.passModel(n, m, rows.nnz, 1, 1, 0.0, form.cost, *bounds, *matrix, np.zeros(n, dtype=np.int32))
    highs.run()
    solved = highs.getModelStatus() == highspy.HighsModelStatus.kOptimal
    return float(highs.getInfo().objective_function_value) if solved else None


def static_costs(case: Case, scenario: Scenario, load: Array) -> Array:
    """Cost of the dispatch that knows no dynamics at some loads, (n,)."""
    prices = np.array([scenario.cost[bus] for bus in case.generators])
    slack = np.array(scenario.cost[case.slack])
    power = merit_order(case, np.tile(prices, (len(load), 1)), np.tile(slack, len(load)), load)
    return power @ prices + slack * np.abs(power.sum(axis=1) + load.sum(axis=1))


def increase(grid: Grid, index: int, which: int) -> float | None:
    """Cost of not knowing when the ramp of a load begins, % of hindsight; None: a program has no solution."""
    case = grid.case
    scenario = sample_scenario(case, SEED, index, servable, DURATION_S)
    random = np.random.default_rng([SEED, index])
    steps, per_part, longest = (round(t / KNOT_S) for t in (DURATION_S, PART_S, BRANCH_S))
    times = np.arange(steps + longest + 1) * KNOT_S
    bus = case.loads[which]
    own = scenario.load[bus].model_copy(update={"ramps": ()})
    calm = scenario.model_copy(update={"load": scenario.load | {bus: own}}).p_load(case, times)
    trunk, leaves = Tree(), []
    before, parts = -1, steps // per_part
    courses = []
    for part in range(parts):
        for sign in (1.0, -1.0):
            start = (part * per_part + random.uniform(0.0, per_part)) * KNOT_S
            lasts, rate = random.uniform(*case.sampling.duration_s), random.uniform(*case.load_rate[:, which])
            course = calm.copy()
            course[:, which] += sign * rate * np.clip(times - start, 0.0, lasts)
            courses.append((part * per_part, course))
    share = 1.0 / len(courses)
    later = 0.0
    for k in range(steps + 1):
        reached = sum(begin <= k for begin, _ in courses)
        left = 1.0 - reached * share  # that it has not begun by now
        begun = [course for begin, course in courses if begin == k]
        if left > 0.0 or begun:
            before = trunk.add(before, calm[k], left)
        leaves += [(before, k, course) for course in begun]
    for root, k, course in leaves:
        last, end = root, min(k + longest, steps)
        trunk.weight[root] += share
        for j in range(k + 1, end + 1):
            last = trunk.add(last, course[j], share)
        if end < steps:
            later += share * float(static_costs(case, scenario, course[end + 1 : steps + 1]).sum())
    causal = grid.least_cost(scenario, trunk)
    if causal is None:
        return None
    known = 0.0
    for _, k, course in leaves:
        line, last, end = Tree(), -1, min(k + longest, steps)
        for j in range(end + 1):
            last = line.add(last, (course if j > k else calm)[j], 1.0)
        found = grid.least_cost(scenario, line)
        if found is None:
            return None
        known += share * found
    return 100 * ((causal + later) / (known + later) - 1.0)


def main(name: str, count: str, loads: str = "") -> None:
    """Print the mean over scenarios with a 95 % confidence interval, for each load."""
    case = Case.load(name)
    grid = Grid(case)
    for which, bus in enumerate(case.loads):
        if not loads or bus in loads.split(","):
            found = [increase(grid, index, which) for index in range(int(count))]
            known = np.array([one for one in found if one is not None])
            half = 1.96 * known.std(ddof=1) / np.sqrt(len(known))
            print(
                f"{name}, load {bus}: {known.mean():.3f} ± {half:.3f} % of hindsight, {len(known)} of {count}"
                " scenarios with a solution",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:4])
