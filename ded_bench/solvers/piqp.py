"""PIQP: a proximal interior-point method, here on linear programs given by their arrays."""

from __future__ import annotations

import time

import numpy as np
import piqp
import scipy.sparse as sp

from ded_bench.solvers.linear_program import FormAnswer, FreeForm, told
from ded_bench.solvers.status import Status

#: The programs of this suite take 15 to 60 iterations.
MAX_ITERATIONS = 100
#: Relative duality gap that is small enough: round-off lets some programs stall at 5e-9.
GAP = 1e-7
#: What keeps factors of singular matrices finite: PIQP's own value.
REGULARISATION = 1e-10


def solve_form(
    form: FreeForm,
    time_limit_s: float = np.inf,
    staged: bool = False,
    regularisation: float = REGULARISATION,
    residual: float | None = None,
) -> FormAnswer:
    """Solve a linear program.

    PIQP knows no clock: a time limit is turned into a number of iterations that fit into it.

    Args:
        form: the program.
        time_limit_s: s; may be infinite.
        staged: columns are ordered by stages, as in optimal control, and rows join neighbouring ones only.
            Dense blocks along the diagonal are then factorised instead of a sparse matrix; that pays where
            stages have tens of columns.
        regularisation: least one of the factorised matrix, also near a solution, where PIQP by itself goes on
            down until some programs end as no numbers. A smaller one gives more accurate steps; a sparse
            factorisation does not stand it.
        residual: of rows, absolute and relative, that is small enough; PIQP's own values if not given.

    Returns:
        `Optimal`, `TimeLimit` or `Failed`: what is infeasible and what is hard PIQP does not tell apart well.
    """
    started = time.perf_counter()
    solver = piqp.SparseSolver()
    if staged:
        solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.settings.max_iter = MAX_ITERATIONS
    solver.settings.eps_duality_gap_rel = GAP
    if residual is not None:
        solver.settings.eps_abs = solver.settings.eps_rel = residual
    solver.settings.reg_lower_limit = solver.settings.reg_finetune_lower_limit = regularisation
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
    return told(form, FormAnswer(status, x, iterations, f"piqp {piqp.__version__}", found.name))
