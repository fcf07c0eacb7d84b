"""Compiled functions: loops over plain arrays, where NumPy would be felt by users."""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.event import Listener, register
from numba.core.types import unliteral
from numpy.typing import NDArray

from ded_bench.problem.quantities import Array, Indices

Function = TypeVar("Function", bound=Callable[..., object])


class _Announced(Listener):
    """Says once, to a person at a terminal, what the first call of a process waits for."""

    told = False

    def on_start(self, _: object) -> None:
        if not self.told and sys.stderr.isatty():
            print("ded-bench: compiling, once after installing: up to a minute", file=sys.stderr, flush=True)
        self.told = True

    def on_end(self, _: object) -> None:
        pass


register("numba:compile", _Announced())  # type: ignore[no-untyped-call]

_PACKAGE = Path(__file__).resolve().parents[1]


def compiled(function: Function) -> Function:
    """Compile when first called; kept on disk, if the package's or the user's folder can be written.

    What is kept is of use as long as no compiled source of the package changes: Numba itself looks at a
    function's own file only, not at those of the functions that it calls.
    """
    return _compiled(function, {})


def allocation_free(function: Function) -> Function:
    """As `compiled`, for what makes no arrays: references, whose counting takes long, are not counted."""
    return _compiled(function, {"_nrt": False})  # as Numba's own do, see its `register_jitable`


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    try:
        made: Any = numba.njit(cache=True, nogil=True, **options)(function)
    except RuntimeError:  # there is no such folder
        return cast(Function, numba.njit(nogil=True, **options)(function))
    if made is function:  # NUMBA_DISABLE_JIT: somebody debugs
        return function
    made._cache._cache_file._version = sources_stamp()  # looked at before anything of the file is unpickled
    resolve = made.get_call_template  # callers that are compiled: one version for all literal integers
    made.get_call_template = lambda args, named: resolve(tuple(map(unliteral, args)), named)
    return cast(Function, made)


def inlined(function: Function) -> Function:
    """Compile into every compiled function that calls it: a call of its own would count array references."""
    return cast(Function, numba.njit(inline="always")(function))


@inlined
def copy_row(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy one row: an assignment of arrays, whose shapes Numba checks, takes longer to compile."""
    for i in range(len(target)):
        target[i] = source[i]


@functools.cache
def sources_stamp(package: Path = _PACKAGE) -> str:
    """Changes with Numba, and any source below a folder that holds compiled functions."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if b"@compiled" in content or b"@allocation_free" in content:
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + content)
    return digest.hexdigest()


@compiled
def interpolated(t: Array, rows: Array, times: Array) -> Array:
    """Rows (n_times, n) at some times, linear between those at `t`, ascending; the last one stays."""
    found = np.empty((len(times), rows.shape[1]))
    for i, time in enumerate(times):
        k = np.searchsorted(t[1:], time, side="right")
        copy_row(rows[k], found[i])
        if k + 1 < len(t):
            length, passed = max(t[k + 1] - t[k], 1e-200), max(time - t[k], 0.0)  # as near as numbers can be
            for j in range(rows.shape[1]):
                found[i, j] += (rows[k + 1, j] - rows[k, j]) / length * passed
    return found


@compiled
def march(
    f: Array, which: Indices, state: Array, force: Array, growth: Array, points: Indices, found: Array
) -> None:
    """March a linear model through its intervals, one after another, so that a map stays in the cache.

    Args:
        f: maps of states from grid point to grid point, (n_maps, n_state, n_state), contiguous.
        which: the map of each interval, (n_intervals,).
        state: at its start, (n_intervals, n_state).
        force: what inputs add over its first step, (n_intervals, n_state).
        growth: by how much that grows from step to step, (n_intervals, n_state).
        points: grid points of the knots, (n_intervals + 1,).
        found: receives the states between knots, (n_points, n_state).
    """
    for j in range(len(which)):
        now, push = state[j], force[j].copy()
        for k in range(points[j] + 1, points[j + 1]):
            np.dot(f[which[j]], now, found[k])
            for i in range(len(push)):
                found[k, i] += push[i]
                push[i] += growth[j, i]
            now = found[k]
