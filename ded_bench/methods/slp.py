"""Sequential linear programming: one loop for every method that linearises.

What an answer leads to is followed (a schedule is simulated on the case's plant); a linear program around it
has the next answer; a step rule says how far to go there; and so on until a stop rule is content. `ded-slp`
runs it until a simulation confirms its program; `ded-ko-knots` and `ded-rti` solve one program along one
trajectory; `ded` with `accelerated=on` runs it on the Euler equations.

Here are the loop, and how programs on knots get the rows they need.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from ded_bench.methods.knot_program import KnotProgram, Limit, Prediction
from ded_bench.methods.step_rules import Followed, NoStepError, StepRule
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

#: Programs on one linear model; with priced excess a rough answer will do.
MAX_PROGRAMS, MAX_SOFT_PROGRAMS = 15, 4
#: So many programs in a row without a solution show that there is none.
PATIENCE = 2


class Answer(Protocol):
    """What a program came to."""

    @property
    def status(self) -> Status:
        """`Infeasible` comes with the answer of least excess, all but `Optimal` with none."""

    @property
    def wanted(self) -> Array:
        """Where to go."""

    @property
    def iterations(self) -> int:
        """Of the solver."""

    @property
    def version(self) -> str:
        """Of the solver."""

    @property
    def message(self) -> str:
        """The solver's last word."""


F = TypeVar("F", bound=Followed)
A = TypeVar("A", bound=Answer)


@dataclass(frozen=True, eq=False)
class Parts(Generic[F, A]):
    """What makes a sequence."""

    follow: Callable[[Array], F]  # raises SimulationError
    solve: Callable[[F, int], A]  # the program around what was followed, and its number
    rule: StepRule
    stop: Callable[[F, A], bool] | None  # whether what was followed confirms its program; None: one program


@dataclass(frozen=True, eq=False)
class End(Generic[F, A]):
    """How a sequence ended."""

    status: Status
    followed: F | None  # the last one
    answer: A | None  # of the last program
    iterations: int
    message: str


def sequence(parts: Parts[F, A], first: Iterable[Array], deadline: float) -> End[F, A]:
    """Run the loop.

    Args:
        parts: its parts.
        first: what to follow at first: the first of these that can be.
        deadline: on the clock of `time.perf_counter`.

    Returns:
        `Optimal` if the stop rule was content, or the one program was solved; `Infeasible` if `PATIENCE`
        programs, or the one, have no solution; `TimeLimit`; else `Failed`, and the message says why.
    """
    now, answer, iterations, without, reason = None, None, 0, 0, ""
    for at in first:
        try:
            now = parts.follow(at)
            break
        except SimulationError as error:
            reason = str(error)
    if now is None:
        return End(Status.FAILED, None, None, 0, reason)
    for number in range(parts.rule.most_programs):
        if time.perf_counter() > deadline:
            return End(
                Status.TIME_LIMIT, now, answer, iterations, "the time limit passed between two programs"
            )
        answer = parts.solve(now, number)
        iterations += answer.iterations
        is_solved = answer.status in (Status.OPTIMAL, Status.INFEASIBLE)
        is_limited = is_solved and parts.rule.limits(now, answer)
        without = without + 1 if answer.status == Status.INFEASIBLE and not is_limited else 0
        if not is_solved or without == PATIENCE or parts.stop is None:
            return End(answer.status, now, answer, iterations, answer.message)
        try:
            now, reached = parts.rule.step(now, answer, parts.follow)
        except NoStepError as error:
            return End(Status.FAILED, now, answer, iterations, str(error))
        if reached is not None and not is_limited and parts.stop(reached, answer):
            return End(Status.OPTIMAL, reached, answer, iterations, "")
    reason = f"no convergence in {parts.rule.most_programs} programs"
    return End(Status.FAILED, now, answer, iterations, reason)


@dataclass(frozen=True)
class Rows:
    """How limits of |ω| become rows of a program on knots."""

    open: float  # excess that needs no further row, or makes nothing infeasible, rad/s
    enough: float  # excess with which to stop, rad/s; no less than `open`
    by_interval: bool = False  # what least excess means, see `KnotProgram.solve_relaxed`
    soft: bool = False  # every excess has a price from the start


@dataclass(frozen=True, eq=False)
class Attempt:
    """What solving a program with rows added came to; there is a prediction if it is solved."""

    status: Status
    prediction: Prediction | None
    iterations: int
    version: str
    message: str

    @property
    def wanted(self) -> Array:
        """Powers at the knots, shape (n_knots, n_gen), pu."""
        assert self.prediction is not None
        return self.prediction.p_gen


def solve_with_rows_added(program: KnotProgram, limits: set[Limit], rows: Rows, deadline: float) -> Attempt:
    """Solve, look at all grid points, limit |ω| where it comes near the bound, and again.

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
        places, widening = np.array(sorted(limits), dtype=int).reshape(-1, 2), 0.0
        if rows.soft:
            answer = program.solve_soft(places, deadline - time.perf_counter())
        elif not infeasible:
            answer = program.solve(places, deadline - time.perf_counter())
        if not rows.soft and (infeasible or answer.status == Status.FAILED):  # none, or PIQP finds none
            iterations += 0 if infeasible else answer.iterations
            left = deadline - time.perf_counter()
            answer, widening = program.solve_relaxed(places, left, rows.by_interval)
        iterations += answer.iterations
        if answer.status != Status.OPTIMAL:
            break
        prediction = program.predict(answer.x)
        excess, added = program.excess(prediction.omega), program.near(prediction.omega) - limits
        limits |= added if excess > rows.open else set()
        infeasible = infeasible or widening > rows.open
        if not added or (not rows.by_interval if infeasible else excess <= rows.enough):
            break
    if answer.status != Status.OPTIMAL and not (rows.soft and prediction is not None):
        return Attempt(answer.status, None, iterations, answer.version, answer.message)
    is_beyond = infeasible or (rows.soft and excess > rows.open)
    status = Status.INFEASIBLE if is_beyond else Status.OPTIMAL
    return Attempt(status, prediction, iterations, answer.version, answer.message)
