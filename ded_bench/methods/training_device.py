"""How torch trains: at full precision, with results that repeat; checkpoints are read without trust."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically


@contextlib.contextmanager
def repeatable() -> Iterator[None]:
    """Train so that results repeat: on one thread, from which these networks lose nothing.

    A GPU convolves in single precision, as the CPU does (cuDNN's default keeps ten bits), and the same
    way every time.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.set_num_threads(threads)


def save_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write tensors, numbers and containers of them."""
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    write_atomically(path, buffer.getvalue())


@contextlib.contextmanager
def reading_checkpoint(path: Path, device: str) -> Iterator[Any]:
    """The state that `save_checkpoint` wrote; whatever fails inside the block is the checkpoint's fault.

    Raises:
        InputError: it is no checkpoint, or one of another training.
    """
    try:
        yield torch.load(path, weights_only=True, map_location=device)
    except Exception:  # of pickle, zipfile and torch alike
        problem = "is no checkpoint of this training; remove it, or train without --resume"
        raise InputError(path, "", problem) from None
