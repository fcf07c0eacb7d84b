"""Full DED by orthogonal collocation: Radau's scheme on elements that end at the loads' kinks.

The same problem as `ded`, with the DAE discretised to high order (see `radau_program`). What it
costs, in time and accuracy, to use backward Euler instead shows when both are re-simulated. On the detailed
plant set-points bend at the case's knots (see `radau_detailed`): an optimum that owes nothing to `ded-slp`.
"""

from __future__ import annotations

import functools
import itertools
import time
from dataclasses import dataclass

import numpy as np
import pyomo.environ as pyo
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import is_reachable, knot_points
from ded_bench.methods.options import option, read_options
from ded_bench.methods.radau_detailed import DetailedProgram, mesh
from ded_bench.methods.radau_program import POINTS, RadauProgram
from ded_bench.methods.solution import Settings, Solution, Solver, answer, too_large
from ded_bench.plants.detailed.detailed_plant import DetailedPlant
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.solvers.ipopt import CasadiIpopt, run_ipopt
from ded_bench.solvers.status import Status

#: Raised when answers change.
VERSION = 1
#: Longest mean element where none is given, s and in periods of the fastest mode (validation draws).
LONGEST_S, LONGEST_PERIODS = 0.1, 0.125
#: Memory that IPOPT takes for an entry of all elements' blocks. Measured as the peak of a
#: process that solves one instance, less what imports take: 16 bytes on 39bus (0.7 GiB in all), 11 on
#: 68bus (1.3 GiB); on 9bus 93 and on two-area 56, but 0.3 GiB in all. Larger grids are extrapolated.
BYTES_PER_ENTRY = 17
#: Longest element on the detailed plant, s, and the memory of its Pyomo model and IPOPT (two-area-agc).
DETAILED_S, BYTES_PER_DETAILED_ENTRY = 1.0, 300
#: Tolerance of IPOPT as a part of the cost. With four times as much it ends, on some processors, 3e-5 above
#: the optimum of a test's island; with less the cost changes by 1e-6 at most, in as many iterations.
CLOSE = 5e-8


@dataclass(frozen=True)
class Options:
    """How finely time is divided."""

    element_s: float | None = option(None, "length of elements, s; none: by the fastest mode", lowest=1e-3)


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return a solver of single instances; one program per process serves them all."""
    length_s = read_options(Options, settings.options).element_s
    if case.plant_name == "detailed":
        return functools.partial(_on_detailed, case, regime, length_s or DETAILED_S, settings.time_limit_s)
    if case.plant_name != "lossless":
        raise InputError(f"case {case.id}", "schema", f"no equations of plant {case.plant_name} are known")
    length_s = length_s or default_element(case)

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        elements = element_count(case, instance, length_s)
        columns = len(POINTS) * (len(case.generators) + case.n_bus + 1) + len(case.generators)
        needed = BYTES_PER_ENTRY * elements * columns**2  # as if each element were a dense block
        if refusal := too_large(needed, f"the program of {elements} elements", "`ded-slp` takes less"):
            return refusal
        ends = element_ends(instance, elements)
        program = _program(case, elements, settings.time_limit_s)
        arguments = program.arguments(instance, regime, ends)
        build_s = time.perf_counter() - started
        outcome, x = run_ipopt(program.solver, arguments, 0.0)
        return answer(outcome, build_s, lambda: None if x is None else program.schedule(x, instance, ends))

    return solve


def _on_detailed(
    case: Case, regime: str, longest_s: float, time_limit_s: float | None, instance: Instance
) -> Solution:
    """Solve on the detailed plant; a program for each instance, since elements end at its kinks."""
    started = time.perf_counter()
    plant = DetailedPlant(case)
    state = plant.initial(instance)
    points = mesh(plant, instance, state, longest_s)
    elements, system = len(points.ends) - 1, plant.system
    columns = len(POINTS) * (len(system.moving) + len(state.v)) + len(case.generators)
    needed = BYTES_PER_DETAILED_ENTRY * elements * columns**2
    if refusal := too_large(needed, f"the Pyomo model of {elements} elements", "`ded-slp` takes less"):
        return refusal
    if not is_reachable(case, instance, points.knots):
        return Solution(Status.INFEASIBLE, error=Status.INFEASIBLE.sentence)
    program = DetailedProgram(plant, instance, regime, state, points)
    program.start()
    build_s = time.perf_counter() - started
    close = CLOSE * (abs(pyo.value(program.model.cost_total)) or 1.0)
    options = {"tol": close, "compl_inf_tol": close, "constr_viol_tol": 1e-6}
    return answer(CasadiIpopt(program.model, options).solve(time_limit_s), build_s, program.schedule)


_program = functools.lru_cache(maxsize=1)(RadauProgram)


def default_element(case: Case) -> float:
    """Mean length of an element by the fastest mode of the linearisation at the nominal point, s."""
    fastest = float(np.abs(plant_of(case, "lossless").nominal().modes.imag).max())  # 0: all are overdamped
    return min(LONGEST_S, LONGEST_PERIODS * 2 * np.pi / max(fastest, 1e-9))


def element_count(case: Case, instance: Instance, length_s: float) -> int:
    """Number of elements of about a given length; for loads that ramp once it depends on the horizon only."""
    pieces = 2 * len(case.loads) + 1  # a load ramp starts and ends: what lies between needs an element
    pieces = max(pieces, len(knot_points(instance.kinks, instance.dt_s)) - 1)
    return min(max(round(instance.horizon_s / length_s), pieces), instance.steps)


def element_ends(instance: Instance, elements: int) -> NDArray[np.int_]:
    """Grid indices k of the element ends, shape (elements + 1,), from 0 to the last.

    Every kink of a load is an end, rounded to the grid; between kinks the elements are of nearly equal
    length, and the longest is as short as can be.
    """
    pieces = list(itertools.pairwise(knot_points(instance.kinks, instance.dt_s).tolist()))
    counts = [1] * len(pieces)
    for _ in range(elements - len(pieces)):
        lengths = [(b - a) / count for (a, b), count in zip(pieces, counts, strict=True)]
        counts[lengths.index(max(lengths))] += 1
    inner = [np.linspace(a, b, count + 1).round()[:-1] for (a, b), count in zip(pieces, counts, strict=True)]
    return np.append(np.concatenate(inner), instance.steps).astype(int)
