"""Compiled functions: loops over plain arrays, where NumPy would be felt by users.

Numba's cache on disk notices that a function's own file changed, not that a function which it calls did:
compiled functions call only those of their own file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile when first called; kept on disk, if the package's or the user's folder can be written."""
    try:
        return cast(Function, numba.njit(cache=True, nogil=True)(function))
    except RuntimeError:  # there is no such folder
        return cast(Function, numba.njit(nogil=True)(function))
