"""Selection: which instances of a benchmark are meant, by split or by file, and of which version they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from ded_bench.files.errors import InputError
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance, load_instances
from ded_bench.problem.sampling import (
    VALIDATION_SEED,
    Servable,
    load_manifest,
    load_split,
    sample_instances,
)

SplitName = Literal["test", "train", "validation", "all"]
#: What `--split` may say; `all` are the instances that are files.
SPLITS: tuple[str, ...] = get_args(SplitName)
#: How many validation instances there are unless a limit says otherwise.
VALIDATION_COUNT = 100


@dataclass(frozen=True)
class Selection:
    """Instances of one case, each with its split (`train`, `test`, `validation` or `none`)."""

    case: Case
    instances: tuple[tuple[Instance, str], ...]
    version: str  # of the problem files, from their manifest; empty without one


def problem_folder(name: str | Path, case: Case) -> Path:
    """The folder that holds a case's instances: the one given, or that of the shipped case."""
    path = Path(name)
    if (path / "case.json").is_file():
        return path
    return path.parent if path.is_file() else SHIPPED_CASES / case.id


def select_split(
    name: str | Path, split: str = "test", limit: int | None = None, servable: Servable | None = None
) -> Selection:
    """Choose the first `limit` instances of a split, in the order of their ids.

    Args:
        name: a shipped case, a benchmark's folder, or its case.json.
        split: `test`, `train`, `validation` (drawn afresh, see `validation_instances`) or `all`.
        servable: tells which instances the power flow can serve, where some are drawn.

    Raises:
        InputError: there is no such case or split, or a file is missing or wrong.
    """
    case = Case.load(name)
    folder = problem_folder(name, case)
    if split == "validation":
        manifest = load_manifest(folder)
        count = VALIDATION_COUNT if limit is None else limit
        drawn = validation_instances(case, count, servable=servable)
        return Selection(case, tuple((i, split) for i in drawn), manifest.version if manifest else "")
    known = load_split(folder)
    named = {"train": known.train, "test": known.test, "all": known.train + known.test}
    if split not in named:
        raise InputError("split", split, f"is not one of {', '.join(SPLITS)}")
    ids = sorted(named[split])[:limit]
    instances, case = load_instances([folder / "instances" / f"{i}.json" for i in ids], case)
    return _selection(case, instances, folder)


def validation_instances(
    case: Case, count: int, first: int = 0, servable: Servable | None = None
) -> list[Instance]:
    """Draw validation instances `first` to `first + count - 1` of a case, `<case>-v0000` and so on.

    Weights, prices, steps and variants are chosen on them; they are no part of the benchmark.
    """
    drawn = sample_instances(case, VALIDATION_SEED, count, first, servable)
    return [
        instance.model_copy(update={"id": f"{case.id}-v{index:04d}"})
        for index, instance in enumerate(drawn, start=first)
    ]


def select_files(paths: Sequence[str | Path], case: Case | None = None) -> Selection:
    """Choose the instances of these files; the split is that of the benchmark around the first one.

    Raises:
        InputError: a file is missing or wrong, or the instances do not share one case.
    """
    instances, case = load_instances(paths, case)
    return _selection(case, instances, Path(paths[0]).resolve().parent.parent)


def _selection(case: Case, instances: Sequence[Instance], folder: Path) -> Selection:
    train: Sequence[str] = ()
    test: Sequence[str] = ()
    if (folder / "split.json").is_file():
        split = load_split(folder)
        train, test = split.train, split.test
    manifest = load_manifest(folder)
    named = [(i, "train" if i.id in train else "test" if i.id in test else "none") for i in instances]
    return Selection(case, tuple(named), manifest.version if manifest else "")
