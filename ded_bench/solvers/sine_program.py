"""IPOPT on programs whose only nonlinear terms are sines of linear ones: optimal control of lossless grids.

Values and both derivatives are a few products with sparse matrices, so that there is no model to build and
no symbolic derivative to wait for: measured on collocated DED, set-up takes a fiftieth of the time
that the same program takes in its .nl form, in half the memory or less; IPOPT's iterates are the same.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
import scipy.sparse as sp

from ded_bench.problem.case import Array
from ded_bench.solvers.ipopt import make_ipopt, run_ipopt
from ded_bench.solvers.status import Options, Outcome


@dataclass(frozen=True, eq=False)
class SineNumbers:
    """One instance: minimise cost·x + constant with row_lower <= A x + C sin(D x) <= row_upper.

    All instances of a program have the same C and D, and an A of the same pattern.
    """

    a: sp.csc_matrix  # (n_rows, n_columns)
    row_lower: Array
    row_upper: Array
    lower: Array  # of x
    upper: Array
    cost: Array  # (n_columns,)
    constant: float
    start: Array  # first x


class SineProgram:
    """A program that IPOPT solves for one instance after another; each solve starts from its own numbers.

    Args:
        outer: C, shape (n_rows, n_sines).
        inner: D, shape (n_sines, n_columns).
        options: IPOPT options beyond the defaults.
    """

    def __init__(self, outer: sp.csc_matrix, inner: sp.csc_matrix, options: Options | None = None) -> None:
        self._outer, self._inner, self._options = _constant(outer), _constant(inner), dict(options or {})
        self._solver: casadi.Function | None = None
        self._made_for: float | None = None

    def solve(self, numbers: SineNumbers, time_limit_s: float | None = None) -> tuple[Outcome, Array | None]:
        """Solve one instance; returns what IPOPT reports, and x if there is one."""
        started = time.perf_counter()
        if self._solver is None or self._made_for != time_limit_s:
            self._solver, self._made_for = self._make(_sparsity(numbers.a), time_limit_s), time_limit_s
        arguments = {
            "x0": numbers.start,
            "lbx": numbers.lower,
            "ubx": numbers.upper,
            "lbg": numbers.row_lower,
            "ubg": numbers.row_upper,
            "p": np.concatenate([numbers.a.data, numbers.cost]),
        }
        return run_ipopt(self._solver, arguments, numbers.constant, time.perf_counter() - started)

    def _make(self, pattern: casadi.Sparsity, time_limit_s: float | None) -> casadi.Function:
        """IPOPT with g(x) = A x + C sin(D x), its Jacobian A + C diag(cos(D x)) D, and the Hessian of λ·g."""
        (n_rows, n), inner, outer = pattern.shape, self._inner, self._outer
        x, parameters = casadi.MX.sym("x", n), casadi.MX.sym("p", pattern.nnz() + n)
        a, cost = casadi.MX(pattern, parameters[: pattern.nnz()]), parameters[pattern.nnz() :]
        argument = casadi.mtimes(inner, x)
        f = casadi.dot(cost, x)
        g = casadi.mtimes(a, x) + casadi.mtimes(outer, casadi.sin(argument))
        jacobian = a + casadi.mtimes(outer, casadi.mtimes(casadi.diag(casadi.cos(argument)), inner))
        weight_f, weight_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", n_rows)
        curvature = -casadi.sin(argument) * casadi.mtimes(outer.T, weight_g)
        hessian = casadi.triu(casadi.mtimes(inner.T, casadi.mtimes(casadi.diag(curvature), inner)))
        given, both = ([x, parameters], ["x", "p"]), [x, parameters, weight_f, weight_g]
        # Names of functions, arguments and results are those that CasADi expects.
        options: dict[str, Any] = {
            "grad_f": casadi.Function("nlp_grad_f", given[0], [f, cost], given[1], ["f", "grad_f_x"]),
            "jac_g": casadi.Function("nlp_jac_g", given[0], [g, jacobian], given[1], ["g", "jac_g_x"]),
            "hess_lag": casadi.Function(
                "nlp_hess_l", both, [hessian], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
            ),
        }
        nlp: dict[str, Any] = {"x": x, "p": parameters, "f": f, "g": g}
        return make_ipopt(nlp, self._options, time_limit_s, options)


def _sparsity(matrix: sp.csc_matrix) -> casadi.Sparsity:
    return casadi.Sparsity(*matrix.shape, matrix.indptr.tolist(), matrix.indices.tolist())


def _constant(matrix: sp.csc_matrix) -> casadi.DM:
    return casadi.DM(_sparsity(matrix), matrix.data)
