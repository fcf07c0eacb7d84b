"""Step rules of sequences of linear programs: how far to go to what a program wants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array

#: Programs of a sequence of full steps, and in a trust region, where steps are shorter.
FULL_PROGRAMS, REGION_PROGRAMS = 15, 40
#: A full step is tried so many times, each half as long.
TRIES = 6
#: In a trust region a step that brings less than the first part of what its program promises is not taken;
#: below the second part the radius shrinks, above the third it grows if it limited the step.
TAKEN, POOR, GOOD = 0.1, 0.3, 0.7
#: The radius becomes this part of a step that brings too little, or that the plant cannot follow.
SHORTER, NOT_FOLLOWED = 0.5, 0.25
#: An excess of |ω| as large as its bound counts like this part of the cost, or more if programs ask for it.
PRICE = 0.05
#: Smallest radius, pu.
SMALLEST = 1e-5


class NoStepError(ArithmeticError):
    """No step leads on."""


class Followed(Protocol):
    """What a step leads to."""

    @property
    def at(self) -> Array:
        """Where it is."""


F = TypeVar("F", bound=Followed)


class Step(NamedTuple, Generic[F]):
    """A step taken, or not."""

    around: F  # where the next program is made
    reached: F | None  # what the program's answer itself leads to, if it was followed


class StepRule(Protocol):
    """How far to go."""

    @property
    def most_programs(self) -> int:
        """A sequence that is longer does not converge."""

    @property
    def radius(self) -> float:
        """How far the next program may go in any component; infinite if it may go anywhere."""

    def limits(self, now: Followed, answer: Any) -> bool:
        """Whether the radius limits an answer."""

    def step(self, now: F, answer: Any, follow: Callable[[Array], F]) -> Step[F]:
        """Go there, or not as far.

        Raises:
            NoStepError: no step leads on.
        """


@dataclass
class FullSteps:
    """All the way, or half as far again and again where that cannot be followed."""

    most_programs: int = FULL_PROGRAMS
    tries: int = TRIES
    radius: float = np.inf

    def limits(self, now: Followed, answer: Any) -> bool:
        """Never."""
        return False

    def step(self, now: F, answer: Any, follow: Callable[[Array], F]) -> Step[F]:
        """See `StepRule.step`."""
        at = answer.wanted
        for number in range(self.tries):
            try:
                new = follow(at)
                return Step(new, new if number == 0 else None)
            except SimulationError as error:
                reason = error
            at = (now.at + at) / 2
        raise NoStepError(f"no step on the way to the program's answer can be followed: {reason}")


@dataclass
class TrustRegion:
    """Steps within a radius that shrinks where linear models are not right.

    Progress is measured by cost + price · excess of |ω| (Fletcher and Sainz de la Maza, Nonlinear programming
    and nonsmooth optimization by successive linear programming, 1989). What is followed has a `cost` and an
    excess `over` (rad/s, none below zero), an answer a `prediction` of both.
    """

    bound: float  # of |ω|, rad/s
    over: Callable[[Array], float]  # excess of some ω, as what is followed has it
    most_programs: int = REGION_PROGRAMS
    radius: float = np.inf
    _price: float = 0.0

    def limits(self, now: Followed, answer: Any) -> bool:
        """Whether a component goes as far as it may."""
        return float(np.abs(answer.wanted - now.at).max()) > 0.999 * self.radius

    def step(self, now: Any, answer: Any, follow: Callable[[Array], Any]) -> Step[Any]:
        """See `StepRule.step`; without progress the next program is around the same place."""
        if self.radius < SMALLEST:
            raise NoStepError("no step brings the schedule closer to one that is feasible")
        size = float(np.abs(answer.wanted - now.at).max())
        saved = now.cost - answer.prediction.objective
        closer = now.over - self.over(answer.prediction.omega)
        self._price = max(self._price, PRICE * abs(now.cost) / self.bound)
        if closer > 0.0:
            self._price = max(self._price, -2.0 * saved / closer)
        promised = saved + self._price * closer
        try:
            new = follow(answer.wanted)
        except SimulationError:
            self.radius = NOT_FOLLOWED * size
            return Step(now, None)
        gained = now.cost - new.cost + self._price * (now.over - new.over)
        if gained > GOOD * promised and self.limits(now, answer):
            self.radius *= 2.0
        if gained < POOR * promised:
            self.radius = SHORTER * size
        return Step(new if gained >= TAKEN * promised else now, new)
