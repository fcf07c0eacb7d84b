"""Trained models and policies on their way to workers that do not have them: a few hundred kB per task."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ded_bench.methods.solution import Settings

#: Contents by their path below a results folder.
Files = tuple[tuple[str, bytes], ...]


def pack(settings: Settings, regime: str) -> Files:
    """Read every file that a method may look for under these settings, in a regime."""
    found: dict[str, Path] = {}
    for folder in settings.search:
        for pattern in ("koopman/*.safetensors", f"policies/*-{glob.escape(regime)}*.safetensors"):
            for path in sorted(folder.glob(pattern)):
                found.setdefault(path.relative_to(folder).as_posix(), path)
    if settings.policy:
        found[_place("policy", settings.policy)] = settings.policy
    if Path(settings.model).is_file():
        found[_place("model", settings.model)] = Path(settings.model)
    return tuple((name, path.read_bytes()) for name, path in found.items())


@contextlib.contextmanager
def unpacked(settings: Settings, files: Files) -> Iterator[Settings]:
    """Settings that find the packed files, which lie in a temporary folder until the end of the block."""
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as name:
        folder = Path(name)
        for place, content in files:
            (folder / place).parent.mkdir(exist_ok=True)
            (folder / place).write_bytes(content)
        model = folder / _place("model", settings.model)
        yield dataclasses.replace(
            settings,
            search=(folder,),
            policy=settings.policy and folder / _place("policy", settings.policy),
            model=str(model) if model.is_file() else settings.model,
        )


def _place(kind: str, path: str | Path) -> str:
    return f"{kind}/{Path(path).name}"
