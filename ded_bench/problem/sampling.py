"""The sampler of the paper's Table III, the benchmark's files and their manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
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


def sample_instance(case: Case, master: int, index: int) -> Instance:
    """Draw instance `index` of master seed `master` (paper, Table III and eq. for P_i(0)).

    All draws are plain uniforms in a fixed order, so that a file is the same on every machine; the
    initial generator power uses the rounded values that the file holds.
    """
    ranges = case.sampling
    n_gen, n_load = len(case.generators), len(case.loads)
    draws = _draws(master, index, 1 + 2 * n_gen + 6 * n_load + n_gen)
    cost = _rounded(_between(ranges.cost, draws[: 1 + n_gen]))
    rest = draws[1 + n_gen :]
    load = rest[: 6 * n_load].reshape(n_load, 6)
    spread = (-ranges.load_relative, ranges.load_relative)
    initial = _rounded(case.load_nominal * (1 + _between(spread, load[:, 0])))
    start = _rounded(_between(ranges.start_s, load[:, 1]))
    duration = _rounded(_between(ranges.duration_s, load[:, 2]))
    sign = np.where(load[:, 4] < 0.5, -1.0, 1.0)
    rate = _rounded(_between(case.load_rate, load[:, 3]) * sign)
    rate = np.where(load[:, 5] < ranges.rate_zero_probability, 0.0, rate)
    last = rest[6 * n_load :].reshape(2, n_gen)
    perturbation = _between(ranges.perturbation, last[0])
    omega = _rounded(_between(ranges.omega_rad_per_s, last[1]))
    p_opt = merit_order(case, cost[1:], cost[0], initial)
    power = _rounded(p_opt - 0.5 * (p_opt - case.p_nominal) * perturbation)
    return Instance(
        schema_="ded-bench/instance/1",
        id=f"{case.id}-{index:04d}",
        case=case.id,
        seed=(master, index),
        horizon_s=ranges.horizon_s,
        dt_s=ranges.dt_s,
        cost=dict(zip((case.slack, *case.generators), cost.tolist(), strict=True)),
        load={
            bus: LoadRamp(initial=values[0], start=values[1], duration=values[2], rate=values[3])
            for bus, values in zip(
                case.loads, np.stack([initial, start, duration, rate], axis=1).tolist(), strict=True
            )
        },
        initial=Initial(
            power=dict(zip(case.generators, power.tolist(), strict=True)),
            omega=dict(zip(case.generators, omega.tolist(), strict=True)),
        ),
    )


def sample_instances(case: Case, master: int, count: int, first: int = 0) -> Iterator[Instance]:
    """Draw instances `first` to `first + count - 1` of a master seed."""
    return (sample_instance(case, master, index) for index in range(first, first + count))


def draw_split(ids: list[str], seed: int) -> Split:
    """Choose a fifth of the instances at random for testing, at least one."""
    order = np.argsort(np.random.default_rng(np.random.SeedSequence([seed])).random(len(ids)), kind="stable")
    n_test = max(1, round(TEST_FRACTION * len(ids)))
    test = set(order[:n_test].tolist())
    return Split(
        seed=seed,
        train=tuple(name for i, name in enumerate(ids) if i not in test),
        test=tuple(name for i, name in enumerate(ids) if i in test),
    )


def write_benchmark(case: Case, count: int, seed: int, folder: Path) -> Manifest:
    """Write case, instances, split and manifest of a benchmark into `folder`.

    Raises:
        InputError: the folder holds another case.
    """
    if not (folder / "case.json").exists():
        write_record(case, folder / "case.json")
    elif Case.load(folder) != case:
        raise InputError(
            folder / "case.json", "", f"is another case than {case.id}, or another version of it"
        )
    written: dict[str, Instance] = {}
    for instance in sample_instances(case, seed, count):
        written[instance.id] = instance
        write_record(instance, folder / "instances" / f"{instance.id}.json")
    for stale in sorted((folder / "instances").glob("*.json")):
        if stale.stem not in written:
            stale.unlink()
    write_record(draw_split(list(written), seed), folder / "split.json")
    names = ["case.json", "split.json", *(f"instances/{name}.json" for name in written)]
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    whole = hashlib.sha256("".join(f"{k} {v}\n" for k, v in sums.items()).encode()).hexdigest()
    manifest = Manifest(version=f"1-{whole[:12]}", files=sums)
    write_atomically(folder / "MANIFEST.json", manifest.model_dump_json(by_alias=True, indent=1) + "\n")
    return manifest


def load_split(folder: Path) -> Split:
    """Read the split of a benchmark folder; InputError if it is missing or wrong."""
    return read_record(Split, folder / "split.json")


def load_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a benchmark folder; None if the folder has none."""
    path = folder / "MANIFEST.json"
    return read_record(Manifest, path) if path.is_file() else None


def _draws(master: int, index: int, count: int) -> Array:
    return np.random.default_rng(np.random.SeedSequence([master, index])).random(count)


def _between(ends: Range | Array, uniform: Array) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * uniform)


def _rounded(values: Array) -> Array:
    return np.round(values, DECIMALS) + 0.0  # + 0.0: no negative zero in the files
