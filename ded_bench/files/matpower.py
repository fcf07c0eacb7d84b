"""Matrices of a MATPOWER case file, which is parsed, never executed."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_text

_COMMENT = re.compile(r"%[^\n]*|\.\.\.[^\n]*\n")
_STATEMENT = re.compile(
    r"\s*(?:function\b[^\n]*|(?:end|return)\s*;?(?=\s|$)"
    r"|\w+\.(?P<name>[\w.]+)\s*="
    r"\s*(?:\[(?P<matrix>[^\]]*)\]|\{[^}]*\}|'[^'\n]*'|(?P<number>[-+.\w]+))[ \t]*(?:;|\n|$))"
)


def read_matpower(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """The matrices and numbers that a file assigns, by name; a number is of shape (1, 1).

    Raises:
        InputError: the file cannot be read, or has anything but assignments, whose effect would be missing.
    """
    text = _COMMENT.sub("", read_text(path))
    found, place = {}, 0
    while text[place:].strip():
        statement = _STATEMENT.match(text, place)
        if statement is None:
            said = text[place:].strip().splitlines()[0][:60]
            raise InputError(path, repr(said)[1:-1], "only assignments of plain data are read")
        place = statement.end()
        if (content := statement["matrix"] or statement["number"]) is not None:
            rows = [
                row.replace(",", " ").split() for row in re.split(r"[;\n]", content) if row.strip(" ,\t\r")
            ]
            found[statement["name"]] = _matrix(path, statement["name"], rows)
    return found


def _matrix(path: str | Path, name: str, rows: list[list[str]]) -> NDArray[np.float64]:
    values = np.zeros((len(rows), max(map(len, rows), default=0)))
    for i, row in enumerate(rows):
        if len(row) != values.shape[1]:
            raise InputError(path, f"{name}, row {i + 1}", f"has {len(row)} values, not {values.shape[1]}")
        for j, cell in enumerate(row):
            try:
                values[i, j] = float(cell)
            except ValueError:
                raise InputError(path, f"{name}, row {i + 1}", f"{cell[:20]!r} is not a number") from None
            if math.isnan(values[i, j]):
                raise InputError(path, f"{name}, row {i + 1}", "has what is not a number")
    return values
