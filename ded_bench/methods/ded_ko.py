"""DED-KO: the paper's linear program over all points of the horizon, on a surrogate.

On a lifted model it is the paper's formulation. By default PIQP solves it. Where the surrogate varies in
time, and on grids where it would take minutes, the default is another program with the same optimum (see
`knot_program`: every grid point is a knot).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from ded_bench.files.errors import InputError
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution, Solver, too_large
from ded_bench.methods.surrogate_program import solve_on_surrogate
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers import highs, ipopt, piqp
from ded_bench.solvers.linear_program import FormAnswer, FreeForm, Indices
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import Surrogate, find_surrogate
from ded_bench.surrogates.koopman import Koopman

#: Raised when answers change.
VERSION = 1
#: Linear solvers by name.
SOLVERS: dict[str, Callable[[FreeForm, float], FormAnswer]] = {
    "piqp": piqp.solve_form,
    "ipopt": ipopt.solve_form,
    "highs": highs.solve_form,
}
#: Entries of the equations up to which the default is the paper's program (two-area has half of it).
PAPER_ENTRIES = 1_000_000
#: Limit of the other programs where none is given: HiGHS, the last resort, knows no end on large grids.
TIME_LIMIT_S = 1800.0
#: Bytes that a program takes for each entry of its equations (39bus).
BYTES_PER_ENTRY = 150


@dataclass(frozen=True)
class Options:
    """How the program is solved."""

    solver: str = option(
        "piqp", "piqp solves another program where the paper's would be too large", choices=tuple(SOLVERS)
    )


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances on the surrogate that the settings name."""
    return prepare_with(
        case, find_surrogate(case, settings.model or "koopman", settings.search), regime, settings
    )


def prepare_with(case: Case, surrogate: Surrogate, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances.

    Raises:
        InputError: the solver wants a lifted model, and this surrogate is none.
    """
    case.check_regimes([regime])
    solver = read_options(Options, settings.options).solver
    if solver != "piqp" and not isinstance(surrogate, Koopman):
        raise InputError("--set", f"solver={solver}", f"only piqp solves `ded-ko` on {surrogate.kind}")

    def solve(instance: Instance) -> Solution:
        points, entries = np.arange(instance.steps + 1), _entries(case, surrogate, instance.steps)
        if refusal := too_large(
            BYTES_PER_ENTRY * entries, f"the program of {len(points)} points", "`ded-ko-knots` takes fewer"
        ):
            return refusal
        if isinstance(surrogate, Koopman) and (solver != "piqp" or entries <= PAPER_ENTRIES):
            return _solve(case, surrogate, regime, solver, settings.time_limit_s, instance)
        limit_s = TIME_LIMIT_S if settings.time_limit_s is None else settings.time_limit_s
        # Softly, since one widening for all of thousands of intervals would be a dense column.
        solution = solve_on_surrogate(
            case, surrogate, instance, case.bounds(regime), points, limit_s, soft=True
        )
        return replace(solution, schedule=None) if solution.status == Status.INFEASIBLE else solution

    return solve


def _entries(case: Case, surrogate: Surrogate, steps: int) -> int:
    """Entries of the equations of the program of all points, if all blocks are dense."""
    n_gen = len(case.generators)
    n_state = len(surrogate.k) if isinstance(surrogate, Koopman) else 2 * n_gen
    return steps * n_state * (n_state + 2 * n_gen + 1)


def _solve(
    case: Case, koopman: Koopman, regime: str, solver: str, time_limit_s: float | None, instance: Instance
) -> Solution:
    """Solve the paper's program; what PIQP does not solve, IPOPT decides."""
    koopman.check_step(instance)
    started = time.perf_counter()
    form, columns, values = paper_program(case, koopman, instance, regime)
    built = time.perf_counter()
    left = np.inf if time_limit_s is None else time_limit_s
    answer = SOLVERS[solver](form, left)
    if answer.status == Status.FAILED and solver == "piqp":
        spent = time.perf_counter() - built
        other = ipopt.solve_form(form, max(left - spent, 1e-3))  # IPOPT wants some
        version, message = f"{answer.version}, {other.version}", f"{answer.message}, {other.message}"
        answer = replace(other, version=version, message=message)
    found = Solution(
        status=answer.status,
        iterations=answer.iterations,
        build_s=built - started,
        setup_s=0.0,
        solve_s=time.perf_counter() - built,
        solver_version=answer.version,
    )
    if answer.status not in (Status.OPTIMAL, Status.FEASIBLE):
        return replace(found, error=answer.message)
    constant = float(instance.cost_gen(case) @ instance.p_initial(case))
    values[columns] = answer.x
    points = instance.steps + 1
    p_gen = values[len(koopman.k) * points :].reshape(-1, points)[: len(case.generators)]
    schedule = Schedule(instance.grid, p_gen.T)
    return replace(found, schedule=schedule, solver_objective=float(form.cost @ answer.x) + constant)


def paper_program(
    case: Case, koopman: Koopman, instance: Instance, regime: str
) -> tuple[FreeForm, Indices, Array]:
    """The paper's eq. (DED_KO) of one instance.

    With P = (generators, loads) and the G of `Koopman`, eq. (KO_dyn) is
    ψ_{k+1} = K ψ_k + ((I - K) B - G) P_k + G P_{k+1}. Its columns are ψ, generators, loads and P_s up and
    down, each at all points; loads and what is given at t = 0 are no columns of the form.

    Returns:
        The form, in which columns stand as rows first name them, which of all columns are its own, and all
        columns' values, where they are given.
    """
    steps, (n_psi, n_input), n_gen = instance.steps, koopman.b.shape, len(case.generators)
    psi, p_initial = koopman.initial(Network(case), [instance])[0], instance.p_initial(case)
    now, last, points = sp.eye(steps, steps + 1, 1), sp.eye(steps, steps + 1), sp.eye(steps + 1)
    before = (np.eye(n_psi) - koopman.k) @ koopman.b - koopman.g

    def blocks(at_end: Array, at_start: Array) -> sp.csr_matrix:
        """A matrix times what is at the end of every step, another times what is at its start."""
        return sp.kron(sp.csr_matrix(at_end), now, "csr") + sp.kron(sp.csr_matrix(at_start), last, "csr")

    own = np.eye(n_gen, n_input) / koopman.dt_s
    parts: list[list[Any]] = [
        [blocks(np.eye(n_psi), -koopman.k), blocks(-koopman.g, -before), None, None],
        [sp.kron(-np.eye(n_psi)[[n_gen]], points, "csr"), None, points, -points],
        [None, blocks(own, -own), None, None],
    ]
    rows = sp.csr_matrix(sp.bmat(parts))
    lower, upper = np.full((2, n_psi + n_input + 2, steps + 1), [[[-np.inf]], [[np.inf]]])
    lower[:n_gen], upper[:n_gen] = -case.omega_bound(regime), case.omega_bound(regime)
    lower[:n_psi, 0] = upper[:n_psi, 0] = psi
    p_gen, p_load = slice(n_psi, n_psi + n_gen), slice(n_psi + n_gen, n_psi + n_input)
    lower[p_gen], upper[p_gen] = case.p_min[:, None], case.p_max[:, None]
    lower[p_gen, 0] = upper[p_gen, 0] = p_initial
    lower[p_load] = upper[p_load] = instance.p_load(case).T
    lower[-2:] = 0.0
    cost = np.zeros_like(lower)
    cost[p_gen], cost[-2:] = instance.cost_gen(case)[:, None], instance.cost_slack(case)
    columns, first = np.unique(rows.indices, return_index=True)
    columns = columns[np.argsort(first)]
    is_free = (lower != upper).ravel()
    values = np.where(is_free, 0.0, lower.ravel())
    right = -(rows.tocsc()[:, columns] @ values[columns])
    columns = columns[is_free[columns]]
    rows, equal = rows[:, columns], steps * n_psi + steps + 1
    ramp = np.repeat(case.ramp, steps)
    form = FreeForm(
        cost=cost.ravel()[columns],
        equal=sp.csc_matrix(rows[:equal]),
        right=right[:equal],
        between=sp.csc_matrix(rows[equal:]),
        low=right[equal:] - ramp,
        high=right[equal:] + ramp,
        lower=lower.ravel()[columns],
        upper=upper.ravel()[columns],
    )
    return form, columns, values
