"""PIQP on linear programs whose rows join neighbouring stages only, as in optimal control.

Its multistage factorisation works on dense blocks along the diagonal: measured on the programs of
`ded-slp`, it takes a fiftieth of the time of HiGHS's simplex method at 9 generators, and 4 s at 47.
"""

from __future__ import annotations

import importlib
import time
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import scipy.sparse as sp

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Array
from ded_bench.solvers.linear_program import FreeForm
from ded_bench.solvers.status import Status

#: The programs of `ded-slp` take 15 to 60 iterations.
MAX_ITERATIONS = 150
#: Relative duality gap that is small enough: round-off lets some programs stall at 5e-9.
GAP = 1e-7


@dataclass(frozen=True, eq=False)
class StagedAnswer:
    """What PIQP says; x has values only with status `Optimal`."""

    status: Status
    x: Array
    iterations: int
    version: str
    message: str


def solve_staged(form: FreeForm, time_limit_s: float) -> StagedAnswer:
    """Solve a program whose columns are ordered by stage, and whose rows join neighbouring stages.

    PIQP knows no clock: a time limit is turned into a number of iterations that fit into it.

    Returns:
        `Optimal`, `TimeLimit` or `Failed`: what is infeasible and what is hard PIQP does not tell apart well.

    Raises:
        InputError: the package `piqp` is not installed.
    """
    started = time.perf_counter()
    piqp = _piqp()
    solver = piqp.SparseSolver()
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.settings.max_iter = MAX_ITERATIONS
    solver.settings.preconditioner_scale_cost = True
    solver.settings.eps_duality_gap_rel = GAP
    n = len(form.cost)
    solver.setup(
        sp.csc_matrix((n, n)),
        form.cost,
        form.equal,
        form.right,
        form.between,
        form.low,
        form.high,
        form.lower,
        form.upper,
    )
    version = f"piqp {piqp.__version__}"
    if np.isfinite(time_limit_s):
        begun = time.perf_counter()
        solver.settings.max_iter = 1
        solver.solve()
        now = time.perf_counter()
        rest = (time_limit_s - (now - started)) / (now - begun)  # the start takes as long as an iteration
        solver.settings.max_iter = min(MAX_ITERATIONS, max(int(2 * rest), 1))
    found = solver.solve()
    x, iterations = np.array(solver.result.x), int(solver.result.info.iter)
    if found == piqp.PIQP_SOLVED:
        status = Status.OPTIMAL
    elif found == piqp.PIQP_MAX_ITER_REACHED and solver.settings.max_iter < MAX_ITERATIONS:
        status = Status.TIME_LIMIT
    else:
        status = Status.FAILED
    return StagedAnswer(status, x, iterations, version, found.name)


def _piqp() -> ModuleType:
    try:
        return importlib.import_module("piqp")
    except ImportError:
        raise InputError("piqp", "", "not installed; `pip install piqp` or use other settings") from None
