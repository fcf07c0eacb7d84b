"""Sequential linear programming: one loop for every method that linearises.

A place is followed (a schedule is simulated on the case's plant); a linear program around what was found has
the next place; a step goes there, or half as far where nothing can be followed; and so on until a stop rule
is content. `ded-slp` runs it until a simulation confirms its program; `ded-ko-knots` and `ded-rti` solve one
program along one trajectory; `ded` with `accelerated=on` runs it on the Euler equations.

Here are the loop, and how programs on knots get the rows they need.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from ded_bench.methods.knot_program import SOFT_PRICE, KnotProgram, Limit, Prediction
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

#: Programs on one linear model; with priced excess a rough answer will do.
MAX_PROGRAMS, MAX_SOFT_PROGRAMS = 15, 4
#: What set-points that are fixed at limits may cost, as a part of the cost; else a program without the wrong
#: ones follows.
FIXED_COST = 1e-6
#: A sequence that is longer does not converge.
SEQUENCE = 15
#: A step is tried so many times, each half as long.
TRIES = 6
#: So many programs in a row without a solution show that there is none.
PATIENCE = 2

F = TypeVar("F")
S = TypeVar("S")


@dataclass(frozen=True, eq=False)
class Attempt(Generic[S]):
    """What a program came to."""

    status: Status  # `Infeasible` comes with the answer of least excess, all but `Optimal` with none
    wanted: Array | None  # where to go
    solution: S | None
    iterations: int
    version: str
    message: str  # the solver's last word


@dataclass(frozen=True, eq=False)
class Parts(Generic[F, S]):
    """What makes a sequence."""

    follow: Callable[[Array], F]  # raises SimulationError
    solve: Callable[[F, int], Attempt[S]]  # the program around what was followed, and its number
    stop: Callable[[F, S], bool] | None  # whether what was followed confirms its program; None: one program
    most_programs: int = SEQUENCE
    tries: int = TRIES


@dataclass(frozen=True, eq=False)
class End(Generic[F, S]):
    """How a sequence ended."""

    status: Status
    followed: F | None  # the last one
    answer: Attempt[S] | None  # of the last program
    iterations: int
    message: str


def sequence(parts: Parts[F, S], first: Iterable[Array], deadline: float) -> End[F, S]:
    """Run the loop.

    Args:
        parts: its parts.
        first: what to follow at first: the first of these that can be.
        deadline: on the clock of `time.perf_counter`.

    Returns:
        `Optimal` if the stop rule was content, or the one program was solved; `Infeasible` if `PATIENCE`
        programs, or the one, have no solution; `TimeLimit`; else `Failed`, and the message says why.
    """
    at, now, reason = _followed(parts.follow, first)
    answer, iterations, without = None, 0, 0
    if now is None:
        return End(Status.FAILED, None, None, 0, reason)
    for number in range(parts.most_programs):
        if time.perf_counter() > deadline:
            reason = "the time limit passed between two programs"
            return End(Status.TIME_LIMIT, now, answer, iterations, reason)
        answer = parts.solve(now, number)
        iterations += answer.iterations
        without = without + 1 if answer.status == Status.INFEASIBLE else 0
        is_solved = answer.status in (Status.OPTIMAL, Status.INFEASIBLE)
        if not is_solved or without == PATIENCE or parts.stop is None or answer.wanted is None:
            return End(answer.status, now, answer, iterations, answer.message)
        wanted, before = answer.wanted, at
        at, new, reason = _followed(parts.follow, _steps(before, wanted, parts.tries))
        if new is None:
            reason = f"no step on the way to the program's answer can be followed: {reason}"
            return End(Status.FAILED, now, answer, iterations, reason)
        now = new
        if at is wanted and answer.solution is not None and parts.stop(now, answer.solution):
            return End(Status.OPTIMAL, now, answer, iterations, "")
    reason = f"no convergence in {parts.most_programs} programs"
    return End(Status.FAILED, now, answer, iterations, reason)


def _followed(follow: Callable[[Array], F], places: Iterable[Array]) -> tuple[Array, F | None, str]:
    """The first place that can be followed, and what it leads to; else why the last could not."""
    at, reason = np.empty(0), ""
    for at in places:
        try:
            return at, follow(at), ""
        except SimulationError as error:
            reason = str(error)
    return at, None, reason


def _steps(now: Array, wanted: Array, tries: int) -> Iterable[Array]:
    """All the way, or half as far again and again."""
    for _ in range(tries):
        yield wanted
        wanted = (now + wanted) / 2


@dataclass(frozen=True)
class Rows:
    """How limits of outputs become rows of a program on knots."""

    open: float  # excess that needs no further row, or makes nothing infeasible, rad/s
    enough: float  # excess with which to stop, rad/s; no less than `open`
    soft: bool = False  # every excess has a price from the start


def solve_with_rows_added(
    program: KnotProgram, limits: set[Limit], rows: Rows, deadline: float
) -> Attempt[Prediction]:
    """Solve, look at all grid points, limit outputs where they come near their bounds, and again.

    Args:
        program: what to solve.
        limits: limits between knots to begin with; those found to be needed are added to it.
        rows: when rows are added.
        deadline: on the clock of `time.perf_counter`.

    Returns:
        `Infeasible` comes with the prediction of least excess.
    """
    iterations, infeasible, prediction, excess = 0, False, None, 0.0
    for _ in range(MAX_SOFT_PROGRAMS if rows.soft else MAX_PROGRAMS):
        places, widened = np.array(sorted(limits), dtype=int).reshape(-1, 3), None
        if rows.soft:
            answer, widened = program.solve_relaxed(places, deadline - time.perf_counter(), SOFT_PRICE)
        elif not infeasible:
            answer = program.solve(places, deadline - time.perf_counter())
        has_none = answer.status in (Status.FAILED, Status.INFEASIBLE)  # or PIQP finds none
        if not rows.soft and (infeasible or has_none):
            iterations += 0 if infeasible else answer.iterations
            answer, widened = program.solve_relaxed(places, deadline - time.perf_counter())
            infeasible = infeasible or float(widened.max()) > rows.open
        iterations += answer.iterations
        if answer.status != Status.OPTIMAL:
            break
        prediction = program.predict(answer.x)
        excess = program.excess(prediction.outputs)
        # What the answer pays for, or cannot avoid, asks for no further rows.
        left_open = program.excess(prediction.outputs, widened)
        least = (rows.enough if np.isfinite(rows.enough) else rows.open) / 2
        added = program.near(prediction.outputs, least, widened) - limits
        limits |= added if excess > rows.open else set()
        is_cheapest = program.fixed.gap <= FIXED_COST * abs(prediction.objective)
        is_divided = program.divide(answer.x, prediction)
        if is_cheapest and not is_divided and (not added or left_open <= rows.enough):
            break
    if answer.status != Status.OPTIMAL and not (rows.soft and prediction is not None):
        return Attempt(answer.status, None, None, iterations, answer.version, answer.message)
    is_beyond = infeasible or (rows.soft and excess > rows.open)
    status = Status.INFEASIBLE if is_beyond else Status.OPTIMAL
    wanted = None if prediction is None else prediction.p_gen
    return Attempt(status, wanted, prediction, iterations, answer.version, answer.message)
