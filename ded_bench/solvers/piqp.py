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
#: Residual of constraints that is small enough where an error of the objective is allowed. Primal ones are
#: met to 1e-8 long before; what is left of dual ones changes objectives by less than that error.
RESIDUAL = 1e-6
#: What keeps factors of singular matrices finite, also near a solution, where PIQP by itself goes on down
#: until some programs end as no numbers: of dense blocks, and of a sparse matrix, which needs more. On drawn
#: scenarios of 39bus ten times as much fails in one of twelve programs of operation, a hundred times in five.
REGULARISATION, SPARSE_REGULARISATION = 1e-11, 1e-10


def solve_form(
    form: FreeForm, time_limit_s: float = np.inf, staged: bool = False, error: float = 0.0
) -> FormAnswer:
    """Solve a linear program; columns whose bounds are equal are taken out.

    PIQP knows no clock: a time limit is turned into a number of iterations that fit into it.

    Args:
        form: the program.
        time_limit_s: s; may be infinite.
        staged: columns are ordered by stages, as in optimal control, and rows join neighbouring ones only.
            Dense blocks along the diagonal are then factorised instead of a sparse matrix; that pays where
            stages have tens of columns.
        error: of the objective that is allowed, in its unit.

    Returns:
        `Optimal`, `TimeLimit` or `Failed`: what is infeasible and what is hard PIQP does not tell apart well.
    """
    started = time.perf_counter()
    solver = piqp.SparseSolver()
    if staged:
        solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.settings.max_iter = MAX_ITERATIONS
    solver.settings.eps_duality_gap_rel = GAP
    if error > 0.0:
        solver.settings.eps_duality_gap_abs, solver.settings.eps_abs = error, RESIDUAL
    least = REGULARISATION if staged else SPARSE_REGULARISATION
    solver.settings.reg_lower_limit = solver.settings.reg_finetune_lower_limit = least
    free = form.lower < form.upper
    equal, between = form.equal[:, free], form.between[:, free]
    x = np.where(free, 0.0, form.lower)
    shift, quadratic = form.between @ x, sp.csc_matrix((np.count_nonzero(free),) * 2)
    limits = form.low - shift, form.high - shift, form.lower[free], form.upper[free]
    solver.setup(quadratic, form.cost[free], equal, form.right - form.equal @ x, between, *limits)
    if np.isfinite(time_limit_s):
        begun = time.perf_counter()
        solver.settings.max_iter = 1
        solver.solve()
        now = time.perf_counter()
        rest = (time_limit_s - (now - started)) / (now - begun)  # the start takes as long as an iteration
        solver.settings.max_iter = min(MAX_ITERATIONS, max(int(2 * rest), 1))
    found = solver.solve()
    result, version = solver.result, f"piqp {piqp.__version__}"
    x[free] = result.x
    price = form.cost + form.equal.T @ result.y + form.between.T @ (result.z_u - result.z_l)
    if found == piqp.PIQP_SOLVED:
        status = Status.OPTIMAL
    elif found == piqp.PIQP_MAX_ITER_REACHED and solver.settings.max_iter < MAX_ITERATIONS:
        status = Status.TIME_LIMIT
    else:
        status = Status.FAILED
    said = status.sentence if status == Status.TIME_LIMIT else found.name
    return told(form, FormAnswer(status, x, result.info.iter, version, said, reduced_cost=price))
