"""DED-KO: the paper's linear program over all points of the horizon, on a surrogate.

On a lifted model it is the paper's formulation, written in Pyomo. By default PIQP solves it. Where the
surrogate varies in time, and on grids whose Pyomo model would take minutes and gigabytes, the default makes
the arrays of the same program directly (see `knot_program`: every grid point is a knot).
"""

from __future__ import annotations

import functools
import itertools
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyomo.environ as pyo

from ded_bench.files.errors import InputError
from ded_bench.methods.ded import add_powers, add_ramps_and_cost, schedule_of, set_powers
from ded_bench.methods.options import option, read_options
from ded_bench.methods.solution import Settings, Solution, Solver, answer, too_large
from ded_bench.methods.surrogate_program import solve_on_surrogate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.solvers.compile import SOLVERS, OnArrays, fix
from ded_bench.solvers.status import Status
from ded_bench.surrogates.find import Surrogate, find_surrogate
from ded_bench.surrogates.koopman import Koopman

#: Raised when answers change.
VERSION = 1
#: Entries of the equations up to which the default is a Pyomo model; half of it takes 10 s and 0.5 GB
#: (two-area), once.
PYOMO_ENTRIES = 1_000_000
#: Limit of the arrays' programs where none is given: HiGHS, the last resort, knows no end on large grids.
TIME_LIMIT_S = 1800.0
#: Bytes that a program takes for each entry of its equations: as arrays (39bus), as a Pyomo model (two-area).
ARRAYS_BYTES, PYOMO_BYTES = 150, 1000


@dataclass(frozen=True)
class Options:
    """How the program is solved."""

    solver: str = option(
        "piqp", "piqp makes arrays where the Pyomo model would be too large", choices=tuple(SOLVERS)
    )


def check(case: Case, settings: Settings) -> None:
    """Raise InputError if the case is an island."""
    if case.slack is None:
        raise InputError("--method", "ded-ko", f"has no slack on the island {case.id}; use ded-ko-knots")


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances on the surrogate that the settings name.

    Raises:
        InputError: see `check`; or the solver wants a lifted model, and this surrogate is none.
    """
    check(case, settings)
    surrogate = find_surrogate(case, settings.model, settings.search)
    solver = read_options(Options, settings.options).solver
    if solver != "piqp" and not isinstance(surrogate, Koopman):
        raise InputError("--set", f"solver={solver}", f"only piqp solves `ded-ko` on {surrogate.kind}")

    limit_s = settings.time_limit_s

    def solve(instance: Instance) -> Solution:
        is_small = solver != "piqp" or _entries(case, surrogate, instance.steps) <= PYOMO_ENTRIES
        if is_small and isinstance(surrogate, Koopman):
            return _solve_model(case, surrogate, regime, solver, limit_s, instance)
        most_s = TIME_LIMIT_S if limit_s is None else limit_s
        return _solve_arrays(case, surrogate, regime, most_s, instance)

    return solve


def _solve_arrays(
    case: Case, surrogate: Surrogate, regime: str, time_limit_s: float, instance: Instance
) -> Solution:
    """Solve by the arrays of the instance's program."""
    points = np.arange(instance.steps + 1)
    needed = ARRAYS_BYTES * _entries(case, surrogate, instance.steps)
    if refusal := too_large(needed, f"the program of {len(points)} points", "`ded-ko-knots` takes fewer"):
        return refusal
    # Softly, since one widening for all of thousands of intervals would be a dense column.
    bounds = case.bounds(regime)
    solution = solve_on_surrogate(case, surrogate, instance, bounds, points, time_limit_s, soft=True)
    return replace(solution, schedule=None) if solution.status == Status.INFEASIBLE else solution


def _entries(case: Case, surrogate: Surrogate, steps: int) -> int:
    """Entries of the equations of the program of all points, if all blocks are dense."""
    n_gen = len(case.generators)
    n_state = len(surrogate.k) if isinstance(surrogate, Koopman) else 2 * n_gen
    return steps * n_state * (n_state + 2 * n_gen + 1)


def _solve_model(
    case: Case, koopman: Koopman, regime: str, solver: str, time_limit_s: float | None, instance: Instance
) -> Solution:
    """Solve by the Pyomo model; one compiled program per process serves all instances."""
    koopman.check_step(instance)
    needed = PYOMO_BYTES * _entries(case, koopman, instance.steps)
    if refusal := too_large(needed, "the Pyomo model", "solver=piqp makes arrays instead"):
        return refusal
    started = time.perf_counter()
    model = _built(case, koopman, instance.steps)
    set_instance(model, case, koopman, instance, regime)
    build_s = time.perf_counter() - started
    return answer(_compiled(model, solver).solve(time_limit_s), build_s, lambda: schedule_of(model, instance))


def build_ded_ko(case: Case, koopman: Koopman, steps: int) -> pyo.ConcreteModel:
    """Return the unsolved LP of the paper's eq. (DED_KO) for any instance of a case.

    What instances differ in - costs, loads, ψ_0, initial power, the regime's bound - are bounds and
    variables that `set_instance` fixes by their bounds. With P = (generators, loads) and the G of
    `Koopman`, eq. (KO_dyn) is ψ_{k+1} = K ψ_k + ((I - K) B - G) P_k + G P_{k+1}.
    """
    n_gen, n_psi = len(case.generators), len(koopman.k)
    m = pyo.ConcreteModel()
    m.point, m.observable = pyo.RangeSet(0, steps), pyo.RangeSet(0, n_psi - 1)

    # Variables; frequencies in rad/s, powers in pu. ψ = (ω, P_s, N).
    add_powers(m, case, m.point)
    m.psi = pyo.Var(m.observable, m.point)

    inputs = [(m.p_gen, g) for g in case.generators] + [(m.p_load, bus) for bus in case.loads]
    before = (np.eye(n_psi) - koopman.k) @ koopman.b - koopman.g

    @m.Constraint(m.observable, m.point)
    def eq_dynamics(m: Any, i: int, k: int) -> Any:
        if k == 0:
            return pyo.Constraint.Skip  # the initial state is given
        terms = [koopman.k[i, j] * m.psi[j, k - 1] for j in m.observable if koopman.k[i, j]]
        for j, (p, bus) in enumerate(inputs):
            terms += [before[i, j] * p[bus, k - 1]] if before[i, j] else []
            terms += [koopman.g[i, j] * p[bus, k]] if koopman.g[i, j] else []
        return m.psi[i, k] == pyo.quicksum(terms)

    @m.Constraint(m.point)
    def eq_slack(m: Any, k: int) -> Any:
        return m.p_slack_up[k] - m.p_slack_down[k] == m.psi[n_gen, k]

    add_ramps_and_cost(m, case, list(m.point), koopman.dt_s)
    return m


_built = functools.lru_cache(maxsize=1)(build_ded_ko)
_compiled = functools.lru_cache(maxsize=1)(OnArrays)


def set_instance(m: pyo.ConcreteModel, case: Case, koopman: Koopman, instance: Instance, regime: str) -> None:
    """Give a built model the data of one instance: solvers of linear programs need no first values."""
    psi = koopman.initial([instance])[0].tolist()
    bound, n_gen = case.omega_bound(regime), len(case.generators)
    set_powers(m, case, instance, psi[n_gen])
    for i, k in itertools.product(range(n_gen), m.point):
        m.psi[i, k].setlb(-bound)
        m.psi[i, k].setub(bound)
    for i, value in enumerate(psi):
        fix(m.psi[i, 0], value)  # x_0 is given, wherever it lies
