"""The sampler of scenarios, their files and their manifest."""

from __future__ import annotations

import hashlib
from pathlib import Path
from statistics import NormalDist

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_record, write_atomically
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Initial, Instance
from ded_bench.problem.sampling import ATTEMPTS, DECIMALS, Manifest, Servable
from ded_bench.problem.scenario import Fluctuation, Scenario, ScenarioLoad, ScenarioRamp

#: Scenarios are drawn from master seeds from here on.
SCENARIO_SEED = 4_000_000
SCENARIOS, DURATION_S = 20, 300.0
#: Loads stay within this part of their nominal value, but for the fluctuation.
LOAD_RANGE = 0.3
#: Standard deviations of announced starts (s) and rates (relative), and how many ramps are not announced.
START_ERROR_S, RATE_ERROR, UNANNOUNCED = 1.5, 0.15, 0.2
#: The fluctuation's standard deviation as a part of the nominal load, and its times, s.
FLUCTUATION, STEP_S, DECAY_S, SMOOTH_S = 0.0005, 0.5, 20.0, 2.0
#: Digits of the fluctuation after the point, in pu: a tenth of a thousandth of its standard deviation.
FLUCTUATION_DECIMALS = 8


def sample_scenario(
    case: Case, seed: int, index: int, servable: Servable | None = None, duration_s: float = DURATION_S
) -> Scenario:
    """Draw scenario `index` of a seed: its numbers come from a generator of its own.

    All draws are plain uniforms in a fixed order, so that a file is the same on every machine. A scenario
    is drawn again, from the same generator, if the power flow cannot serve it.

    Args:
        servable: tells which instances the power flow can serve (`truth.servable`); asked for the loads at
            0, at both ends of every ramp and at the end. None: all of them.

    Raises:
        InputError: the case's ranges leave hardly anything to draw.
    """
    generator = np.random.default_rng(np.random.SeedSequence([SCENARIO_SEED + seed, index]))
    for _ in range(ATTEMPTS):
        scenario = _draw(case, seed, index, generator, duration_s)
        if servable is None or bool(servable(case, _snapshots(case, scenario)).all()):
            return scenario
    raise InputError(f"case {case.id}", "sampling", f"{ATTEMPTS} scenarios in a row cannot be served")


def _snapshots(case: Case, scenario: Scenario) -> list[Instance]:
    ends = {t for load in scenario.load.values() for ramp in load.ramps for t in (ramp.start, ramp.end)}
    last = scenario.duration_s + case.sampling.horizon_s
    return [scenario.snapshot(case, t) for t in sorted({0.0, *(min(t, last) for t in ends), last})]


def _draw(case: Case, seed: int, index: int, generator: np.random.Generator, duration_s: float) -> Scenario:
    ranges = case.sampling
    n_gen = len(case.generators)
    cost = _rounded(_between(ranges.cost, generator.random(1 + n_gen)))
    load = {bus: _draw_load(case, i, generator, duration_s) for i, bus in enumerate(case.loads)}
    p_opt = merit_order(case, cost[1:], cost[0], np.array([load[bus].initial for bus in case.loads]))
    perturbation = _between(ranges.perturbation, generator.random(n_gen))
    power = _rounded(p_opt - 0.5 * (p_opt - case.p_nominal) * perturbation)
    omega = _rounded(_between(ranges.omega_rad_per_s, generator.random(n_gen)))
    return Scenario(
        id=f"{case.id}-s{index:04d}",
        case=case.id,
        seed=(SCENARIO_SEED + seed, index),
        duration_s=duration_s,
        dt_s=ranges.dt_s,
        cost=dict(zip((case.slack, *case.generators), cost.tolist(), strict=True)),
        initial=Initial(
            power=dict(zip(case.generators, power.tolist(), strict=True)),
            omega=dict(zip(case.generators, omega.tolist(), strict=True)),
        ),
        load=load,
    )


def _draw_load(case: Case, number: int, generator: np.random.Generator, duration_s: float) -> ScenarioLoad:
    """One ramp in every horizon of the case; it turns round where it would leave the range."""
    ranges, nominal = case.sampling, float(case.load_nominal[number])
    spread = min(ranges.load_relative, LOAD_RANGE)
    level = initial = float(_rounded(nominal * (1 + _between((-spread, spread), generator.random(1))))[0])
    last, ended, ramps = duration_s + ranges.horizon_s, 0.0, []
    for window in np.arange(0.0, last, ranges.horizon_s):
        start, duration, size, sign, *announced = generator.random(7)
        begin = max(window + float(_between(ranges.start_s, start)), ended)
        length = float(_between(ranges.duration_s, duration))
        rate = float(_between(case.load_rate[:, number], size)) * (1 if sign < 0.5 else -1)
        if abs(level + rate * length - nominal) > LOAD_RANGE * abs(nominal):
            rate = -rate
        room = LOAD_RANGE * abs(nominal) + (nominal - level) * np.sign(rate)
        length = min(length, max(room, 0.0) / abs(rate)) if rate else length
        ramp = _ramp(begin, length, rate, announced)
        level, ended = level + ramp.rate * ramp.duration, ramp.end
        ramps.append(ramp)
    fluctuation = _draw_fluctuation(abs(nominal), last, generator)
    return ScenarioLoad(initial=initial, ramps=tuple(ramps), fluctuation=fluctuation)


def _ramp(start: float, duration: float, rate: float, announced: list[float]) -> ScenarioRamp:
    """A ramp from its values and three uniforms: whether it is announced, and how wrong."""
    start, duration, rate = (float(_rounded(np.array(value))) for value in (start, duration, rate))
    known = announced[0] >= UNANNOUNCED
    error_start, error_rate = START_ERROR_S * _normal(announced[1]), RATE_ERROR * _normal(announced[2])
    return ScenarioRamp(
        start=start,
        duration=duration,
        rate=rate,
        announced_start=float(_rounded(np.maximum(start + error_start, 0.0))) if known else None,
        announced_rate=float(_rounded(np.array(rate * (1 + error_rate)))) if known else None,
    )


def _draw_fluctuation(nominal: float, last: float, generator: np.random.Generator) -> Fluctuation:
    """A random walk that returns within DECAY_S, smoothed over SMOOTH_S; it starts at 0.

    Both are first-order recursions, x⁺ = a x + √(1 - a²) n and y⁺ = b y + (1 - b) x; the stationary
    variance of y is (1 - b) (1 + a b) / ((1 + b) (1 - a b)).
    """
    a, b = np.exp(-STEP_S / DECAY_S), np.exp(-STEP_S / SMOOTH_S)
    n = int(np.ceil(last / STEP_S - 1e-9))
    noise = [_normal(uniform) for uniform in generator.random(n)]
    values, x = np.zeros(n + 1), 0.0
    for k in range(n):
        x = a * x + np.sqrt(1 - a**2) * noise[k]
        values[k + 1] = b * values[k] + (1 - b) * x
    deviation = np.sqrt((1 - b) * (1 + a * b) / ((1 + b) * (1 - a * b)))
    values = np.round(values * (FLUCTUATION * nominal / deviation), FLUCTUATION_DECIMALS) + 0.0
    return Fluctuation(step_s=STEP_S, values=tuple(values.tolist()), decay_s=DECAY_S)


def scenario_folder(problem_folder: Path) -> Path:
    """Where the scenarios of a benchmark's folder lie."""
    return problem_folder / "scenarios"


def write_scenarios(
    case: Case,
    count: int,
    seed: int,
    folder: Path,
    servable: Servable | None = None,
    duration_s: float = DURATION_S,
) -> Manifest:
    """Write scenarios and their manifest into `folder`; scenarios of other seeds there are removed.

    Raises:
        InputError: the case's ranges leave hardly anything to draw.
    """
    sums: dict[str, str] = {}
    for index in range(count):
        scenario = sample_scenario(case, seed, index, servable, duration_s)
        text = scenario.model_dump_json(by_alias=True) + "\n"  # in one line: mostly lists of numbers
        write_atomically(folder / f"{scenario.id}.json", text)
        sums[f"{scenario.id}.json"] = hashlib.sha256(text.encode()).hexdigest()
    for stale in folder.glob("*.json"):
        if stale.name not in sums and stale.name != "MANIFEST.json":
            stale.unlink()
    whole = hashlib.sha256("".join(f"{k} {v}\n" for k, v in sums.items()).encode()).hexdigest()
    manifest = Manifest(version=f"1-{whole[:12]}", files=sums)
    text = manifest.model_dump_json(by_alias=True, indent=1, exclude={"redraws"})
    write_atomically(folder / "MANIFEST.json", text + "\n")
    return manifest


def scenario_files(folder: Path, limit: int | None = None) -> list[Path]:
    """The first `limit` scenarios of a folder, in the order of its manifest; InputError without one."""
    files = sorted(read_record(Manifest, folder / "MANIFEST.json").files)
    return [folder / name for name in files[:limit]]


def _normal(uniform: float) -> float:
    """A standard normal number from a uniform one in [0, 1)."""
    return NormalDist().inv_cdf(max(float(uniform), 2.0**-54))


def _between(ends: tuple[float, float] | Array, uniform: Array | float) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * uniform)


def _rounded(values: Array) -> Array:
    return np.round(values, DECIMALS) + 0.0  # + 0.0: no negative zero in the files
