"""The sampler of the paper's Table III, the benchmark's files and their manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record, write_atomically, write_record
from ded_bench.problem.case import Array, Case, Name, Range
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Initial, Instance, LoadRamp

#: Master seeds of data that must never overlap the benchmark's instances (DESIGN, section 5).
POLICY_SEED, CERTIFICATE_SEED, KOOPMAN_SEED = 1_000_000, 2_000_000, 3_000_000
#: Between the seeds of policies: instances on which choices are made, so that test instances only score.
VALIDATION_SEED = POLICY_SEED + 500_000
DECIMALS = 9
TEST_FRACTION = 0.2
#: How often an instance is drawn before the case's ranges are taken to be wrong.
ATTEMPTS = 1000
#: Instances that are drawn, and checked, together.
CHUNK = 128

#: Tells which of some instances of a case the power flow can serve, shape (n,).
Servable = Callable[[Case, Sequence[Instance]], NDArray[np.bool_]]


class Split(Record):
    """Which instances are for training and which for testing."""

    schema_: Literal["ded-bench/split/1"] = Field(alias="schema", default="ded-bench/split/1")
    seed: int
    train: tuple[Name, ...]
    test: tuple[Name, ...]


class Manifest(Record):
    """Version and SHA-256 of each file; results are comparable only between equal versions."""

    schema_: Literal["ded-bench/manifest/1"] = Field(alias="schema", default="ded-bench/manifest/1")
    version: str
    files: dict[str, str]
    redraws: Annotated[int, Field(ge=0)] = 0  # loads and instances that were drawn again


def sample_instances(
    case: Case, master: int, count: int, first: int = 0, servable: Servable | None = None
) -> Iterator[Instance]:
    """Draw instances `first` to `first + count - 1` of a master seed (see `drawn_with_redraws`)."""
    return (instance for instance, _ in drawn_with_redraws(case, master, count, first, servable))


def sample_instance(case: Case, master: int, index: int, servable: Servable | None = None) -> Instance:
    """Draw instance `index` of master seed `master` (see `drawn_with_redraws`)."""
    return next(sample_instances(case, master, 1, index, servable))


def drawn_with_redraws(
    case: Case, master: int, count: int, first: int = 0, servable: Servable | None = None
) -> Iterator[tuple[Instance, int]]:
    """Draw instances `first` to `first + count - 1` of a master seed, each with how often it drew again.

    An instance's numbers come from a generator of its own, seeded by (master, index). What cannot be used is
    drawn again from that generator: a load that changes its sign (in case/2; some of the paper's 9-bus loads
    do), and an instance that is not servable.

    Args:
        servable: tells which instances the power flow can serve (`truth.servable`); None: all of them.

    Raises:
        InputError: the case's ranges leave hardly anything to draw.
    """
    for start in range(first, first + count, CHUNK):
        indices = range(start, min(start + CHUNK, first + count))
        generators = {i: np.random.default_rng(np.random.SeedSequence([master, i])) for i in indices}
        drawn: dict[int, Instance] = {}
        redraws = dict.fromkeys(indices, 0)
        wanted = list(indices)
        for _ in range(ATTEMPTS):
            for i in wanted:
                drawn[i], repeated = _draw(case, master, i, generators[i])
                redraws[i] += repeated
            if servable is None:
                break
            usable = servable(case, [drawn[i] for i in wanted])
            wanted = [i for i, good in zip(wanted, usable, strict=True) if not good]
            if not wanted:
                break
            for i in wanted:
                redraws[i] += 1
        else:
            raise InputError(f"case {case.id}", "sampling", f"{ATTEMPTS} draws in a row cannot be served")
        yield from ((drawn[i], redraws[i]) for i in indices)


def _draw(case: Case, master: int, index: int, generator: np.random.Generator) -> tuple[Instance, int]:
    """Draw an instance (paper, Table III and eq. for P_i(0)) and count the loads that were drawn again.

    All draws are plain uniforms in a fixed order, so that a file is the same on every machine; the
    initial generator power uses the rounded values that the file holds.
    """
    ranges = case.sampling
    n_gen, n_load = len(case.generators), len(case.loads)
    draws = generator.random(1 + 2 * n_gen + 6 * n_load + n_gen)
    cost = _rounded(_between(ranges.cost, draws[: 1 + n_gen]))
    rest = draws[1 + n_gen :]
    ramps, redraws = _draw_ramps(case, rest[: 6 * n_load].reshape(n_load, 6), generator)
    last = rest[6 * n_load :].reshape(2, n_gen)
    perturbation = _between(ranges.perturbation, last[0])
    omega = _rounded(_between(ranges.omega_rad_per_s, last[1]))
    p_opt = merit_order(case, cost[1:], cost[0], ramps[:, 0])
    power = _rounded(p_opt - 0.5 * (p_opt - case.p_nominal) * perturbation)
    instance = Instance(
        schema_="ded-bench/instance/1",
        id=f"{case.id}-{index:04d}",
        case=case.id,
        seed=(master, index),
        horizon_s=ranges.horizon_s,
        dt_s=ranges.dt_s,
        cost=dict(zip((case.slack, *case.generators), cost.tolist(), strict=True)),
        load={
            bus: LoadRamp(initial=values[0], start=values[1], duration=values[2], rate=values[3])
            for bus, values in zip(case.loads, ramps.tolist(), strict=True)
        },
        initial=Initial(
            power=dict(zip(case.generators, power.tolist(), strict=True)),
            omega=dict(zip(case.generators, omega.tolist(), strict=True)),
        ),
    )
    return instance, redraws


def _draw_ramps(case: Case, uniform: Array, generator: np.random.Generator) -> tuple[Array, int]:
    """Initial value, start, duration and rate of each load from uniforms, shape (n_load, 6) -> (n_load, 4).

    Loads of a case/2 that change their sign are drawn again; also returns how many were. A ramp away from
    zero keeps the sign, and is drawn at least once in four times, so that this ends.
    """
    ramps = _ramps(case, uniform, np.arange(len(uniform)))
    redraws = 0
    while case.schema_ != "ded-bench/case/1" and (changes := np.flatnonzero(_changes_sign(case, ramps))).size:
        ramps[changes] = _ramps(case, generator.random((len(changes), 6)), changes)
        redraws += len(changes)
    return ramps, redraws


def _ramps(case: Case, uniform: Array, loads: NDArray[np.int_]) -> Array:
    ranges = case.sampling
    spread = (-ranges.load_relative, ranges.load_relative)
    initial = _rounded(case.load_nominal[loads] * (1 + _between(spread, uniform[:, 0])))
    start = _rounded(_between(ranges.start_s, uniform[:, 1]))
    duration = _rounded(_between(ranges.duration_s, uniform[:, 2]))
    sign = np.where(uniform[:, 4] < 0.5, -1.0, 1.0)
    rate = _rounded(_between(case.load_rate[:, loads], uniform[:, 3]) * sign)
    rate = np.where(uniform[:, 5] < ranges.rate_zero_probability, 0.0, rate)
    return np.stack([initial, start, duration, rate], axis=1)


def _changes_sign(case: Case, ramps: Array) -> NDArray[np.bool_]:
    """Whether a load has the other sign than its nominal value at 0 or at the horizon, shape (n_load,)."""
    initial, start, duration, rate = ramps.T
    last = initial + rate * np.clip(case.sampling.horizon_s - start, 0.0, duration)
    return np.asarray(np.minimum(initial * case.load_nominal, last * case.load_nominal) < 0)


def draw_split(ids: list[str], seed: int, n_test: int | None = None) -> Split:
    """Choose instances at random for testing: a fifth, at least one, unless `n_test` says how many."""
    order = np.argsort(np.random.default_rng(np.random.SeedSequence([seed])).random(len(ids)), kind="stable")
    n_test = max(1, round(TEST_FRACTION * len(ids))) if n_test is None else n_test
    test = set(order[:n_test].tolist())
    return Split(
        seed=seed,
        train=tuple(name for i, name in enumerate(ids) if i not in test),
        test=tuple(name for i, name in enumerate(ids) if i in test),
    )


def write_benchmark(
    case: Case,
    count: int,
    seed: int,
    folder: Path,
    n_test: int | None = None,
    servable: Servable | None = None,
) -> Manifest:
    """Write case, instances, split and manifest of a benchmark into `folder`.

    Args:
        n_test: how many instances are for testing; None: a fifth.
        servable: as of `drawn_with_redraws`.

    Raises:
        InputError: the folder holds another case, there are fewer instances than test instances, or the
            case's ranges leave hardly anything to draw.
    """
    if n_test is not None and n_test > count:
        raise InputError("instances", "test", f"{n_test} of {count} instances cannot be for testing")
    if not (folder / "case.json").exists():
        write_record(case, folder / "case.json")
    elif Case.load(folder) != case:
        raise InputError(
            folder / "case.json", "", f"is another case than {case.id}, or another version of it"
        )
    written: dict[str, int] = {}
    for instance, redraws in drawn_with_redraws(case, seed, count, servable=servable):
        written[instance.id] = redraws
        write_record(instance, folder / "instances" / f"{instance.id}.json")
    for stale in sorted((folder / "instances").glob("*.json")):
        if stale.stem not in written:
            stale.unlink()
    write_record(draw_split(list(written), seed, n_test), folder / "split.json")
    names = ["case.json", "split.json", *(f"instances/{name}.json" for name in written)]
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    whole = hashlib.sha256("".join(f"{k} {v}\n" for k, v in sums.items()).encode()).hexdigest()
    manifest = Manifest(version=f"1-{whole[:12]}", files=sums, redraws=sum(written.values()))
    without = None if manifest.redraws else {"redraws"}
    text = manifest.model_dump_json(by_alias=True, indent=1, exclude=without)
    write_atomically(folder / "MANIFEST.json", text + "\n")
    return manifest


def load_split(folder: Path) -> Split:
    """Read the split of a benchmark folder; InputError if it is missing or wrong."""
    return read_record(Split, folder / "split.json")


def load_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a benchmark folder; None if the folder has none."""
    path = folder / "MANIFEST.json"
    return read_record(Manifest, path) if path.is_file() else None


def _between(ends: Range | Array, uniform: Array) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * uniform)


def _rounded(values: Array) -> Array:
    return np.round(values, DECIMALS) + 0.0  # + 0.0: no negative zero in the files
