"""Trained models and policies on their way to workers that do not have them: a few hundred kB per task."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.solution import Settings

#: Contents by their path below a results folder, or below `GIVEN`.
Files = tuple[tuple[str, bytes], ...]
#: Folder of files that the settings name by their paths.
GIVEN = "given"


def pack(settings: Settings, artifacts: Iterable[Artifact]) -> Files:
    """Read every file that an answer depends on."""
    return tuple((_place(a.kind, a.path, settings), a.path.read_bytes()) for a in artifacts if a.path)


@contextlib.contextmanager
def unpacked(settings: Settings, files: Files) -> Iterator[Settings]:
    """Settings that find the packed files, which lie in a temporary folder until the end of the block."""
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as name:
        folder = Path(name)
        for place, content in files:
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).write_bytes(content)
        policy, model = settings.policy, settings.model
        places = {place for place, _ in files}
        if policy is not None:
            policy = folder / _given("policy", policy)
        if _given("model", model) in places:
            model = str(folder / _given("model", model))
        yield dataclasses.replace(settings, search=(folder,), policy=policy, model=model)


def _place(kind: str, path: Path, settings: Settings) -> str:
    """Where methods look for a file: by its path in the settings, else below a folder to search."""
    if path not in (settings.policy, Path(settings.model)):
        for folder in settings.search:
            if path.is_relative_to(folder):
                return path.relative_to(folder).as_posix()
    return _given(kind, path)


def _given(kind: str, path: str | Path) -> str:
    return f"{GIVEN}/{kind}/{Path(path).name}"
