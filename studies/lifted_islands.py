"""How far the paper's idea gets on an island: linear programs on linear and on identified models.

Three surrogates of `ded-ko-knots`: `linear`, `trajectory`, and a model identified here, linear in observables
of what can be measured (extended dynamic mode decomposition with control and delays). The rule of secondary
control is known. Everything is chosen on draws of master 3,000,000; test instances only score.

    python studies/lifted_islands.py CASE choose      # errors over the horizon; what no lifted model can do
    python studies/lifted_islands.py CASE losses      # the same errors where lines have no resistance
    python studies/lifted_islands.py CASE test COUNT  # what is planned, judged on the plant
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from exchange_bound import with_ramps_of
from knowing import altered, no_losses

from ded_bench import Case, Instance, Schedule, SimulationError, load_instances
from ded_bench.methods import ded_ko_knots
from ded_bench.methods.knots import case_knots
from ded_bench.methods.solution import Settings
from ded_bench.plants.hold import Hold, across_intervals, doubled
from ded_bench.plants.plant import plant_of, servable, simulate
from ded_bench.plants.score import score
from ded_bench.plants.time_varying import Delivered, Reset, TimeVarying
from ded_bench.problem.quantities import Array, Indices
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instance
from ded_bench.surrogates.find import AlongTrajectory, find_surrogate

#: Time step of identified models, s.
STEP_S = 0.1
#: Trajectories to train on, and held out; the first draw of these.
TRAIN, HELD_OUT, HELD_OUT_FIRST = 60, 12, 1_000_000
#: Pairs of held-out draws that exchange what they do.
PAIRS = 6
#: Planned schedules are moved at the knots by a random walk of steps of this standard deviation, pu.
WALK = 0.01
HZ = 2.0 * np.pi


COLUMNS = (
    *("regime", "model", "plans", "feasible", "over `ded-slp`, %", "mean, mHz", "swings, mHz"),
    *("excess / bound, median", "largest", "time, s"),
)


class Variant(NamedTuple):
    """What an identified model sees."""

    delays: int  # earlier samples of what is measured, and of the inputs
    angles: bool = True  # relative angles are measured, beside frequencies and turbines' powers
    products: bool = False  # of relative angles, among the observables
    ridge: float = 1e-8  # of normalised features


VARIANTS = {
    "ω, P_m": Variant(0, angles=False),
    "ω, P_m, angles": Variant(0),
    "and 1 sample before": Variant(1),
    "and 2 before": Variant(2),
    "and 4 before": Variant(4),
    "and 8 before": Variant(8),
    "2 before, products of angles": Variant(2, products=True),
}
RIDGES = (1e-6, 1e-8, 1e-10)
#: Those of the least error of the mean frequency in `choose`.
CHOSEN = {"two-area-agc": Variant(2, ridge=1e-8), "39bus-agc": Variant(1, ridge=1e-10)}


class Samples(NamedTuple):
    """One trajectory by deviations from its start, every STEP_S."""

    theta: Array  # relative angles, (n, n_gen - 1), rad
    omega: Array  # (n, n_gen), rad/s
    p_m: Array  # (n, n_gen), pu
    p_set: Array  # (n, n_gen), pu
    held: Array  # by secondary control from each point on, (n,), pu
    load: Array  # (n, n_load), pu


def coarse(instance: Instance) -> Instance:
    """The instance on a grid of STEP_S."""
    return Instance.model_validate(instance.model_dump(by_alias=True) | {"dt_s": STEP_S})


def sampled(case: Case, instance: Instance, schedule: Schedule) -> Samples:
    """Simulate and sample."""
    run, every = simulate(case, instance, schedule), round(STEP_S / instance.dt_s)
    names = [case.machine_of(g) for g in case.generators]
    delta = np.stack([run.columns[f"delta_{name}"] for name in names], axis=1)
    theta = delta - delta[0]
    parts = theta[:, :-1], run.omega, run.p_gen - run.p_gen[0], run.p_set - run.p_set[0]
    held, load = run.columns["agc"], run.p_load - run.p_load[0]
    return Samples(*(part[::every] for part in (*parts, held, load)))


def drawn(case: Case, first: int, count: int) -> Iterator[tuple[Instance, Schedule]]:
    """Draws with what `linear` plans for them, moved at random; both regimes in turn."""
    solvers = [ded_ko_knots.prepare(case, r, Settings(model="linear")) for r in ("NO", "TO")]
    for i in range(first, first + count):
        instance = sample_instance(case, KOOPMAN_SEED, i, servable)
        planned = solvers[i % 2](instance).schedule
        if planned is None:
            continue
        rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED, i, 1]))
        walk = WALK * rng.normal(size=planned.p.shape).cumsum(axis=0) * (i % 4 < 2)
        moved = np.clip(planned.p + walk - walk[0], case.p_min, case.p_max)
        yield instance, Schedule(planned.t, moved)


def trajectories(case: Case, first: int, count: int) -> list[Samples]:
    """Those that the plant can follow."""
    found = []
    for instance, schedule in drawn(case, first, count):
        try:
            found.append(sampled(case, instance, schedule))
        except SimulationError:
            continue
    return found


def observables(variant: Variant, s: Samples) -> Array:
    """What is measured, frequencies and turbines' powers first, (n, n_y)."""
    parts = [s.omega, s.p_m] + ([s.theta] if variant.angles else [])
    if variant.products:
        i, j = np.triu_indices(s.theta.shape[1])
        parts.append(s.theta[:, i] * s.theta[:, j])
    return np.hstack(parts)


def delayed(signal: Array, delays: int) -> list[Array]:
    """The signal at points 0 … n - 2 and so many before; it rests before the first."""
    rest = np.zeros((delays, signal.shape[1]))
    whole = np.vstack([rest, signal])
    return [whole[delays - j : delays - j + len(signal) - 1] for j in range(delays + 1)]


def regression(case: Case, variant: Variant, s: Samples) -> tuple[Array, Array]:
    """Features of each step and what is measured after it."""
    y = observables(variant, s)
    shares = plant_of(case).system.shares[plant_of(case).system.scheduled]  # type: ignore[attr-defined]
    given = s.p_set + np.outer(s.held, shares)
    ahead = s.p_set[1:] + np.outer(s.held[:-1], shares)
    columns = [*delayed(y, variant.delays), ahead, *delayed(given, variant.delays)]
    return np.hstack([*columns, s.load[1:], *delayed(s.load, variant.delays)]), y[1:]


@dataclass(frozen=True, eq=False)
class Identified(AlongTrajectory):
    """A model linear in observables; `weights` are by feature, see `regression`."""

    variant: Variant = VARIANTS["and 2 before"]
    weights: Array | None = None  # (n_features, n_y)
    kind: str = "identified"

    @property
    def fingerprint(self) -> str:
        """Of the weights."""
        return hashlib.sha256(np.asarray(self.weights).tobytes()).hexdigest()[:12]

    def along(
        self, instance: Instance, p_gen: Array, points: Indices, exact: bool = True, state: Any = None
    ) -> TimeVarying:
        """See `AlongTrajectory.along`; for instances at rest, on a grid of STEP_S."""
        f, g, h, by_load, reset = self._maps
        case, n = self.plant.case, len(f)
        n_gen, load = len(case.generators), instance.p_load(case)
        load -= load[0]
        force = np.hstack([load[1:], *delayed(load, self.variant.delays)]) @ by_load
        p_set = Schedule(instance.grid[points], p_gen).at(instance.grid) - instance.p_initial(case)
        x = np.zeros((len(p_set), n))
        period = round(case.agc.period_s / STEP_S) if case.agc is not None else len(p_set)
        for k in range(len(p_set) - 1):
            now = reset @ x[k] if k and k % period == 0 else x[k]
            x[k + 1] = f @ now + g @ p_set[k] + h @ (p_set[k + 1] - p_set[k])
            x[k + 1, : force.shape[1]] += force[k]
        n_maps = len(points) - 1
        step = Hold(*(np.broadcast_to(part, (n_maps, *part.shape)) for part in (f, g, h)))
        at = np.flatnonzero((points[:-1] > 0) & (points[:-1] % period == 0))
        across = across_intervals(doubled(step, np.diff(points)), np.diff(points))
        across.f[at] = across.f[at] @ reset
        c = np.zeros((n_gen, n))
        c[:, n_gen : 2 * n_gen] = np.eye(n_gen)
        delivered = Delivered(
            np.broadcast_to(c, (n_maps, *c.shape)),
            np.zeros((n_maps, n_gen, n_gen)),
            x[:, n_gen : 2 * n_gen] + instance.p_initial(case),
        )
        omega, no_slack = x[:, :n_gen], np.zeros(len(p_set))
        slack = np.zeros((n_maps, n))
        return TimeVarying(
            points, step, across, slice(0, n_gen), slack, omega, no_slack, p_gen, delivered, Reset(at, reset)
        )

    @functools.cached_property
    def _maps(self) -> tuple[Array, Array, Array, Array, Array]:
        """x⁺ = f x + g u + h Δu + loads by `by_load`, and AGC's reset.

        x: observables now and before, inputs before, the integral of the mean frequency, what AGC holds.
        """
        assert self.weights is not None
        system, case, d = self.plant.system, self.plant.case, self.variant.delays  # type: ignore[attr-defined]
        inertia, shares = (part[system.scheduled] for part in (system.data.inertia, system.shares))
        n_gen, n_y = len(shares), self.weights.shape[1]
        memory = n_y * (d + 1)
        n = memory + n_gen * d + 2
        sizes = [n_y * (d + 1), n_gen, n_gen, n_gen * d]
        by_y, ahead, now, before, by_load = np.split(self.weights, np.cumsum(sizes))
        f, g, h = np.zeros((n, n)), np.zeros((n, n_gen)), np.zeros((n, n_gen))
        f[:n_y, :memory] = by_y.T
        f[:n_y, memory:-2] = before.T
        f[:n_y, -1] = (ahead + now).T @ shares
        g[:n_y], h[:n_y] = (ahead + now).T, ahead.T
        f[n_y:memory, : memory - n_y] = np.eye(memory - n_y)
        if d:
            first = slice(memory, memory + n_gen)
            g[first], f[first, -1] = np.eye(n_gen), shares
            f[memory + n_gen : -2, memory : -2 - n_gen] = np.eye(n_gen * (d - 1))
        # The integral of the mean frequency by the trapezoidal rule.
        mean = np.zeros(n)
        mean[:n_gen] = STEP_S / 2 * inertia
        f[-2] = mean + mean @ f
        f[-2, -2], f[-1, -1] = 1.0, 1.0
        g[-2], h[-2] = mean @ g, mean @ h
        wide = np.zeros((len(by_load), n))
        wide[:, :n_y] = by_load
        wide[:, -2] = wide @ mean
        reset = np.eye(n)
        if case.agc is not None:
            reset[-1], reset[-1, -2] = 0.0, -case.agc.k
        return f, g, h, wide, reset


def identify(case: Case, variant: Variant, data: list[Samples]) -> Identified:
    """Ridge least squares on all steps of all trajectories, features and observables normalised."""
    pairs = [regression(case, variant, s) for s in data]
    features, after = (np.vstack(part) for part in zip(*pairs, strict=True))
    size, unit = (np.sqrt(np.square(part).mean(axis=0)) + 1e-12 for part in (features, after))
    normal = (features / size).T @ (features / size) / len(features)
    right = (features / size).T @ (after / unit) / len(features)
    solved = np.linalg.solve(normal + variant.ridge * np.eye(len(normal)), right)
    return Identified(plant_of(case), variant=variant, weights=solved / size[:, None] * unit)


def rollout(case: Case, model: AlongTrajectory, instance: Instance, schedule: Schedule) -> Array:
    """What a model says of ω every STEP_S, (n, n_gen), rad/s."""
    known = coarse(instance) if isinstance(model, Identified) else instance
    points = case_knots(case, known)
    told = model.along(known, schedule.at(known.grid[points]), points).omega
    return told[:: round(STEP_S / known.dt_s)]


def on_plant(case: Case, instance: Instance, schedule: Schedule) -> Array:
    """What the plant does, likewise."""
    return simulate(case, instance, schedule).omega[:: round(STEP_S / instance.dt_s)]


def largest(case: Case, change: Array) -> tuple[float, float]:
    """Largest mean frequency and swing about it of frequencies (n, n_gen), mHz."""
    system = plant_of(case).system  # type: ignore[attr-defined]
    mean = change @ system.data.inertia[system.scheduled]
    return float(np.abs(mean).max()) * 1e3 / HZ, float(np.abs(change - mean[:, None]).max()) * 1e3 / HZ


def choose(case: Case) -> None:
    """Errors over the horizon on held-out draws, by variant; the least one by its ridge."""
    data = trajectories(case, 0, TRAIN)
    held_out = [(i, s, on_plant(case, i, s)) for i, s in drawn(case, HELD_OUT_FIRST, HELD_OUT)]
    bound = case.regimes["TO"]
    units = np.array([bound.mean_hz, bound.relative_hz]) * 1e3

    def errors(model: AlongTrajectory) -> Array:
        return np.array([largest(case, rollout(case, model, i, s) - y) for i, s, y in held_out])

    rows = [("`linear`", "", *errors(find_surrogate(case, "linear", [])).mean(axis=0))]
    for label, variant in VARIANTS.items():
        by_ridge = {r: errors(identify(case, variant._replace(ridge=r), data)) for r in RIDGES}
        ridge = min(by_ridge, key=lambda r: float((by_ridge[r] / units).max(axis=1).mean()))
        rows.append((label, f"{ridge:g}", *by_ridge[ridge].mean(axis=0)))
    show(["observables", "ridge", "mean, mHz", "swings, mHz"], rows)
    exchange(case, identify(case, CHOSEN[case.id], data))


def exchange(case: Case, model: Identified) -> None:
    """Pairs exchange increments (see exchange_bound.py): what no lifted model can do, and what two do."""
    linear, rows = find_surrogate(case, "linear", []), []
    pairs = list(drawn(case, HELD_OUT_FIRST, 2 * PAIRS))
    for pair in zip(pairs[::2], pairs[1::2], strict=False):
        four = [
            (with_ramps_of(case, own, other), Schedule(s.t, own.p_initial(case) + s.p - s.p[0]))
            for own, _ in pair
            for other, s in pair
        ]
        try:
            y = [on_plant(case, *one) for one in four]
        except SimulationError:
            continue
        told = [[rollout(case, m, *one) for one in four] for m in (linear, model)]
        errors = [[largest(case, t - one) for t, one in zip(of, y, strict=True)] for of in told]
        least = np.array(largest(case, y[0] - y[1] - y[2] + y[3])) / 4.0
        rows.append([least, *np.mean(errors, axis=1)])
    labels = "any lifted model, at least", "`linear`", "identified"
    means = np.mean(rows, axis=0)
    show(["", "mean, mHz", "swings, mHz"], [(a, *b) for a, b in zip(labels, means, strict=True)])


def losses(true: Case) -> None:
    """Errors of `linear` over the horizon on held-out draws of the case, and of its copy without losses."""
    rows = []
    for label, case in (("the case", true), ("lines without resistance", altered(true.id, no_losses))):
        linear = find_surrogate(case, "linear", [])
        pairs = drawn(case, HELD_OUT_FIRST, HELD_OUT)
        errors = [largest(case, rollout(case, linear, i, s) - on_plant(case, i, s)) for i, s in pairs]
        rows.append((label, *np.mean(errors, axis=0)))
    show(["`linear` on", "mean, mHz", "swings, mHz"], rows)


def test(case: Case, count: int) -> None:
    """What is planned on each surrogate, judged on the plant; `trajectory` by the rows that are kept."""
    model = identify(case, CHOSEN[case.id], trajectories(case, 0, TRAIN))
    instances = list(load_instances(case.id, split="test"))[:count]
    kept = pd.read_csv(Path(__file__).parents[1] / f"results/{case.id}-reference/results.csv")
    kept = kept[(kept.settings == "default") & kept.instance.isin([i.id for i in instances])]
    print(f"| {' | '.join(COLUMNS)} |\n| --- | --- |{' ---: |' * (len(COLUMNS) - 2)}")
    for regime in case.regimes:
        of = kept[kept.regime == regime].set_index("instance")
        best = of[of.method == "ded-slp"].objective
        by_model = {
            "`linear`": planned(case, regime, find_surrogate(case, "linear", []), instances),
            "`trajectory`": of[of.method == "ded-ko-knots"],
            "identified": planned(case, regime, model, instances),
        }
        for name, rows in by_model.items():
            print(f"| {regime} | {name} | {cells(case, regime, rows, best, count)} |", flush=True)


def planned(case: Case, regime: str, surrogate: AlongTrajectory, instances: list[Instance]) -> pd.DataFrame:
    """Scores and times of what has a plan, by instance."""
    rows = {}
    solve = ded_ko_knots.KnotSolver(case, surrogate, regime)
    for instance in instances:
        answer = solve(coarse(instance) if isinstance(surrogate, Identified) else instance)
        if answer.schedule is not None:
            judged = score(case, instance, answer.schedule, regime)
            times = {"build_s": answer.build_s, "solve_s": answer.solve_s}
            rows[instance.id] = vars(judged) | {"feasible": judged.feasible} | times
    return pd.DataFrame.from_dict(rows, orient="index")


def cells(case: Case, regime: str, rows: pd.DataFrame, best: pd.Series[float], count: int) -> str:
    """See COLUMNS."""
    limits = case.regimes[regime]
    over = [rows[f"excess_{k}_hz"] / getattr(limits, f"{k}_hz") for k in ("mean", "relative", "end")]
    excess = pd.concat(over, axis=1).max(axis=1)
    gap = 100 * (rows.objective / best[rows.index] - 1)
    peaks = [1e3 * rows[name] for name in ("mean_freq_max_hz", "swing_max_hz")]
    medians = [f"{part.median():.2f}" for part in (*peaks, excess)]
    seconds = f"{(rows.build_s + rows.solve_s).median():.1f}"
    share = f"{100 * rows.feasible.sum() / count:.0f} %"
    return " | ".join(
        [str(len(rows)), share, f"{gap.median():+.3f}", *medians, f"{excess.max():.2f}", seconds]
    )


def show(columns: list[str], rows: list[tuple[Any, ...]]) -> None:
    """Print a table."""
    print(f"| {' | '.join(columns)} |\n| --- |{' ---: |' * (len(columns) - 1)}")
    for one in rows:
        print("| " + " | ".join(v if isinstance(v, str) else f"{v:.3f}" for v in one) + " |", flush=True)


if __name__ == "__main__":
    case = Case.load(sys.argv[1])
    if sys.argv[2] == "test":
        test(case, int(sys.argv[3]))
    else:
        {"choose": choose, "losses": losses}[sys.argv[2]](case)
