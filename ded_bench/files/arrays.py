"""Named arrays with a JSON header in one safetensors file; reading one executes no code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from ded_bench.files.errors import InputError
from ded_bench.files.strict import regular_size, write_atomically


def write_arrays(path: Path, arrays: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """Write arrays and a header; floats in the header keep their digits."""
    metadata = {key: json.dumps(value) for key, value in header.items()}
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, safetensors.numpy.save(contiguous, metadata))


def read_arrays(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays and header.

    Raises:
        InputError: the file cannot be read, is no safetensors file, or holds non-finite numbers.
    """
    regular_size(path)
    try:
        with safetensors.safe_open(str(path), framework="np") as file:
            header = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
            json.dumps(header, ensure_ascii=False).encode()  # no half of a character, which no text can hold
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except OSError as error:
        raise InputError(path, "", f"cannot be read ({error.strerror or error})") from None
    except Exception as error:  # of safetensors and JSON alike, on damaged files
        reason = " ".join(str(error).split())[:100]
        raise InputError(path, "", f"is not a model or policy file ({reason})") from None
    for name, array in arrays.items():
        if not np.issubdtype(array.dtype, np.floating) or not np.isfinite(array).all():
            raise InputError(path, name, "must hold finite numbers")
    return arrays, header
