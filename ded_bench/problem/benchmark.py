"""A benchmark's folder: its split and manifest, the files that are written, the instances that are meant."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record, write_atomically, write_record
from ded_bench.problem import sampling
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.grid_files import GRID_FILES
from ded_bench.problem.instance import Instance, load_instances
from ded_bench.problem.quantities import Name

SplitName = Literal["test", "train", "validation", "all"]
#: What `--split` may say; `all` are the instances that are files.
SPLITS: tuple[str, ...] = get_args(SplitName)
#: How many validation instances there are unless a limit says otherwise.
VALIDATION_COUNT = 100
TEST_FRACTION = 0.2
MANIFEST = "MANIFEST.json"


class Split(Record):
    """Which instances are for training and which for testing."""

    schema_: Literal["ded-bench/split/1"] = Field(alias="schema")
    seed: int
    train: tuple[Name, ...]
    test: tuple[Name, ...]


class Manifest(Record):
    """Version and SHA-256 of each file; results are comparable only between equal versions."""

    schema_: Literal["ded-bench/manifest/1"] = Field(alias="schema")
    version: str
    files: dict[str, str]
    redraws: Annotated[int, Field(ge=0)] = 0  # loads and instances that were drawn again


def load_split(folder: Path) -> Split:
    """Read the split of a benchmark folder; InputError if it is missing or wrong."""
    return read_record(Split, folder / "split.json")


def load_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a benchmark folder; None if the folder has none."""
    path = folder / MANIFEST
    return read_record(Manifest, path) if path.is_file() else None


def scenario_files(folder: Path, limit: int | None = None) -> list[Path]:
    """The first `limit` scenarios of a folder, in the order of its manifest; InputError without one."""
    if (manifest := load_manifest(folder)) is None:
        case = folder.parent.name if SHIPPED_CASES in folder.parents else folder.parent
        raise InputError(folder, "", f"holds no scenarios; `ded-bench scenarios --case {case}` draws some")
    return [folder / name for name in list(manifest.files)[:limit]]


def draw_split(ids: list[str], seed: int, n_test: int | None = None) -> Split:
    """Choose instances at random for testing: a fifth, at least one, unless `n_test` says how many."""
    order = np.argsort(np.random.default_rng(np.random.SeedSequence([seed])).random(len(ids)), kind="stable")
    n_test = max(1, round(TEST_FRACTION * len(ids))) if n_test is None else n_test
    test = set(order[:n_test].tolist())
    return Split(
        schema_="ded-bench/split/1",
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
    servable: sampling.Servable | None = None,
    source: Path | None = None,
) -> Manifest:
    """Write case, instances, split and manifest of a benchmark into `folder`.

    Args:
        n_test: how many instances are for testing; None: a fifth.
        servable: as of `drawn_with_redraws`.
        source: the case's file, whose bytes, and those of the files beside it that describe the grid, a new
            folder gets, since the version depends on them.

    Raises:
        InputError: the folder holds another case, there are fewer instances than test instances, or the
            case's ranges leave hardly anything to draw.
    """
    if n_test is not None and n_test > count:
        raise InputError("instances", "test", f"{n_test} of {count} instances cannot be for testing")
    place = folder / "case.json"
    if place.exists():
        if Case.load(folder).fingerprint != case.fingerprint:
            raise InputError(place, "", f"is another case than {case.id}, or another version of it")
    elif source is None:
        write_record(case, place)
    else:
        copy_case(source, folder)
    (folder / MANIFEST).unlink(missing_ok=True)  # what is cut short has no version
    written: dict[str, int] = {}
    for instance, redraws in sampling.drawn_with_redraws(case, seed, count, servable=servable):
        written[instance.id] = redraws
        write_record(instance, folder / "instances" / f"{instance.id}.json")
    write_record(draw_split(list(written), seed, n_test), folder / "split.json")
    names = [f"instances/{name}.json" for name in written]
    _remove_others(case, folder / "instances", names)
    own = ["case.json", *(GRID_FILES if case.needs_grid else ())]
    return _write_manifest(folder, [*own, "split.json", *names], sum(written.values()))


def copy_case(source: Path, folder: Path) -> None:
    """Copy a case's file, and those of its grid beside it, into another folder."""
    for path, name in [(source, "case.json"), *((source.parent / name, name) for name in GRID_FILES)]:
        if path.is_file():
            write_atomically(folder / name, path.read_bytes())


def write_scenarios(
    case: Case,
    count: int,
    seed: int,
    folder: Path,
    servable: sampling.Servable | None = None,
    duration_s: float = sampling.DURATION_S,
    hours: int = 0,
) -> Manifest:
    """Write scenarios and their manifest into `folder`; scenarios of other seeds there are removed.

    Args:
        hours: so many scenarios of an hour beside them.

    Raises:
        InputError: the case's ranges leave hardly anything to draw.
    """
    (folder / MANIFEST).unlink(missing_ok=True)  # what is cut short has no version
    names = []
    wanted = [*((i, duration_s) for i in range(count)), *((i, sampling.HOUR_S) for i in range(hours))]
    for index, lasting_s in wanted:
        scenario = sampling.sample_scenario(case, seed, index, servable, lasting_s)
        names.append(f"{scenario.id}.json")
        text = scenario.model_dump_json(by_alias=True)  # in one line: mostly lists of numbers
        write_atomically(folder / names[-1], text + "\n")
    _remove_others(case, folder, names)
    return _write_manifest(folder, names)


def _remove_others(case: Case, folder: Path, names: Iterable[str]) -> None:
    """Remove what was drawn of a case before, and no other file."""
    kept, drawn = {Path(name).name for name in names}, re.compile(rf"{re.escape(case.id)}-[sh]?\d+\.json")
    for path in folder.iterdir():
        if drawn.fullmatch(path.name) and path.name not in kept:
            path.unlink()


def _write_manifest(folder: Path, names: Iterable[str], redraws: int = 0) -> Manifest:
    """Write the manifest of some files of a folder; `redraws` stands in it only where there are any."""
    sums = _sums(folder, names)
    version = _version_of(sums)
    manifest = Manifest(schema_="ded-bench/manifest/1", version=version, files=sums, redraws=redraws)
    text = manifest.model_dump_json(by_alias=True, indent=1, exclude=None if redraws else {"redraws"})
    write_atomically(folder / MANIFEST, text + "\n")
    return manifest


def _sums(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of each file; empty for one that is missing."""
    paths = {name: folder / name for name in names}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for name, path in paths.items()
    }


def _version_of(sums: Mapping[str, str]) -> str:
    """The version of files with these sums."""
    whole = hashlib.sha256("".join(f"{k} {v}\n" for k, v in sums.items()).encode()).hexdigest()
    return f"1-{whole[:12]}"


@dataclass(frozen=True)
class Selection:
    """Instances of one case, each with its split (`train`, `test`, `validation` or `none`)."""

    case: Case
    instances: tuple[tuple[Instance, str], ...]
    version: str  # of the problem files that the manifest names; empty without one


def select_split(
    name: str | Path, split: str = "test", limit: int | None = None, servable: sampling.Servable | None = None
) -> Selection:
    """Choose the first `limit` instances of a split, in the order of their ids.

    Args:
        name: a shipped case, a benchmark's folder, or its case.json.
        split: `test`, `train`, `validation` (drawn afresh, see `validation_instances`) or `all`.
        servable: tells which instances can be served, where some are drawn.

    Raises:
        InputError: there is no such case or split, the limit is negative, or a file is missing or wrong.
    """
    if limit is not None and limit < 0:
        raise InputError("limit", "", f"must be at least 0, or None for all, not {limit}")
    case = Case.load(name)
    if split == "validation":
        count = VALIDATION_COUNT if limit is None else limit
        drawn = validation_instances(case, count, servable=servable)
        return Selection(case, tuple((i, split) for i in drawn), _version(case.folder))
    known = load_split(case.folder)
    named = {"train": known.train, "test": known.test, "all": known.train + known.test}
    if split not in named:
        raise InputError("split", split, f"is not one of {', '.join(SPLITS)}")
    ids = sorted(named[split])[:limit]
    instances, case = load_instances([case.folder / "instances" / f"{i}.json" for i in ids], case)
    return _selection(case, instances, case.folder)


def validation_instances(
    case: Case, count: int, first: int = 0, servable: sampling.Servable | None = None
) -> list[Instance]:
    """Draw validation instances `first` to `first + count - 1` of a case, `<case>-v0000` and so on.

    Weights, prices, steps and variants are chosen on them; they are no part of the benchmark.
    """
    drawn = sampling.sample_instances(case, sampling.VALIDATION_SEED, count, first, servable)
    return [
        instance.model_copy(update={"id": f"{case.id}-v{index:04d}"})
        for index, instance in enumerate(drawn, start=first)
    ]


def instance_file(name: Path, case: str | None = None) -> Path:
    """The file of an instance: the one given, or that of this id in a case's folder, or any shipped one's.

    Raises:
        InputError: it is a name without a folder, and neither a file nor the id of an instance.
    """
    if name.exists() or name.name != str(name) or name.suffix == ".json":
        return name
    folders = [Case.load(case).folder] if case else sorted(SHIPPED_CASES.glob("*"))
    for folder in folders:
        if (found := folder / "instances" / f"{name}.json").is_file():
            return found
    raise InputError("--instance", str(name), "is neither a file nor an instance's id")


def select_files(paths: Sequence[str | Path], case: Case | None = None) -> Selection:
    """Choose the instances of these files; the split is that of the benchmark around the first one.

    Raises:
        InputError: a file is missing or wrong, or the instances do not share one case.
    """
    instances, case = load_instances(paths, case)
    return _selection(case, instances, Path(paths[0]).resolve().parent.parent)


def _version(folder: Path) -> str:
    """The manifest's, as long as its files are those that it was made of; else that of files like these."""
    manifest = load_manifest(folder)
    return _version_of(_sums(folder, manifest.files)) if manifest else ""


def _selection(case: Case, instances: Sequence[Instance], folder: Path) -> Selection:
    split = load_split(folder) if (folder / "split.json").is_file() else None
    named = {} if split is None else dict.fromkeys(split.test, "test") | dict.fromkeys(split.train, "train")
    chosen = tuple((instance, named.get(instance.id, "none")) for instance in instances)
    return Selection(case, chosen, _version(folder))


def check_own_name(instance: Instance, source: str | Path, case: Case) -> None:
    """Check that an instance does not carry the name of another one of its case, whose rows it would replace.

    Raises:
        InputError: the benchmark has an instance of this name with other contents.
    """
    namesake = case.folder / "instances" / f"{instance.id}.json"
    if namesake.is_file() and Instance.load_file(namesake, case)[0] != instance:
        problem = f"{instance.id} is the name of {namesake}, which says something else: choose another"
        raise InputError(source, "id", problem)
