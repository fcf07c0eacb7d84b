"""`ded-admm` on islands: learned penalties, iterations along simulations in coarse steps.

From the loads' changes shared by all machines, sent through the governors' inverse filter, iterations with
costs lead to a first answer; where its simulation comes too near a bound, iterations without costs lead to
set-points near it that keep away. Limits, ramps and P_0 hold for any settings.

A quick policy simulates less: its first schedule by the linear model alone, and small repairs not again.
In operation the plan in force is a warm start.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ded_bench.methods.ed import static_dispatch, within_ramps
from ded_bench.methods.island.island_iterations import (
    SETTINGS,
    Found,
    IslandGrid,
    IslandIterations,
    IslandProblem,
)
from ded_bench.methods.knots import knot_points
from ded_bench.methods.solution import Solution
from ded_bench.methods.state_estimate import StateEstimate
from ded_bench.methods.trained_policy import TrainedPolicy, answered, warm_up
from ded_bench.plants.plant import PlantState, SimulationError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: Penalties of mending, and no price.
MENDING = np.append(np.log([0.5, 0.5, 1.0, 0.5]), -np.inf)
#: So near a bound, in parts of it, answers are mended; so far beyond simulated again, and warm starts left.
NEAR, FAR = 0.05, 0.5
#: How often, at most, and until excess changes no more: in operation plans may begin beyond a bound; how many
#: times as much is left free the last time, since the mean peaks between knots.
MENDED, STUCK, WIDENED = 5, 1e-3, 2.0
#: The grid of a case, regime and horizon, made once.
_grid_of = functools.lru_cache(maxsize=8)(IslandGrid)
#: Iterations without costs, made once for all settings.
mending_of = functools.lru_cache(maxsize=8)(functools.partial(IslandIterations, settings=MENDING))


class IslandPolicy(TrainedPolicy):
    """Learned settings; `training` has rounds, iterations, those of mending, substeps, and if it is quick."""

    method = "ded-admm"
    deciding = ("rounds", "iterations", "mending", "substeps", "quick")

    @functools.cached_property
    def grid(self) -> IslandGrid:
        """The island as the policy sees it."""
        substeps = self.training.get("substeps", 1)
        return _grid_of(self.scope.case, self.scope.regime, self.scope.horizon_s, substeps)

    @functools.cached_property
    def iterate(self) -> IslandIterations:
        """The iterations."""
        return IslandIterations(self.grid, self.weights["settings"][: len(MENDING)])

    def answers(self, instances: Sequence[Instance]) -> Array:
        """See `TrainedPolicy.answers`."""
        return np.stack([self.powers(instance) for instance in instances])

    def powers(
        self, instance: Instance, further: int = 0, state: PlantState = None, last: Schedule | None = None
    ) -> Array:
        """Set-points at the knots, (n_knots, n_gen), pu.

        Args:
            instance: to answer, within the scope.
            further: iterations with costs along the answer, after which it is mended again.
            state: at t = 0; None: what is not measured is stationary.
            last: the plan in force, a warm start from which one round is enough.
        """
        asked, count, found = self.grid.ask(instance, state), self.training["iterations"], None
        quick = self.training.get("quick", False)
        if last is not None:
            start = self.grid.within(last.at(self.knots), asked.p_initial, asked.room)
            found = self._improved(asked, self._followed(asked, start, linear=quick), count, rounds=1)
        if found is None or found.excess > FAR:
            other = self._improved(asked, self._followed(asked, asked.start, linear=quick), count)
            found = min(filter(None, (found, other)), key=lambda one: one.excess, default=None)
        if found is None:  # static dispatch is what every instance can be served by
            case, points = self.scope.case, knot_points(self.knots, instance.dt_s)
            served = within_ramps(case, instance, static_dispatch(case, instance, lead=False), points)
            found = self._improved(asked, self._followed(asked, served, linear=quick), count)
            if found is None:
                return served
        if further:
            found = self._improved(asked, found, further) or found
        return found.schedule

    def _improved(
        self, asked: IslandProblem, first: Found | None, count: int, rounds: int | None = None
    ) -> Found | None:
        """The first far enough from bounds, else that with the least excess; None: none can be carried."""
        if first is None:
            return None
        dual, seen, margins = None, [first], np.exp(self.weights["settings"][len(MENDING) :])
        for _ in range(rounds or self.training["rounds"]):
            answer, dual = self.iterate(asked, seen[-1], count, margins, dual)
            seen.append(self._followed(asked, answer) or seen[-1])
        if seen[1] is first:
            return None
        for number, more in enumerate(np.linspace(1.0, WIDENED, MENDED), 1):
            if seen[-1].excess <= -NEAR:
                return seen[-1]
            count = number * self.training["mending"]  # few serve most instances
            answer, _ = mending_of(self.grid)(asked, seen[-1], count, more * margins)
            mended = self.grid.moved(seen[-1], answer)
            if self.training.get("quick", False) and seen[-1].excess <= FAR and mended.excess <= -NEAR:
                return mended
            seen.append(self._followed(asked, answer) or seen[-1])
            if seen[-1] is not seen[-2] and abs(seen[-1].excess - seen[-2].excess) < STUCK:
                break
        return min(seen[1:], key=lambda found: found.excess)

    def _followed(self, asked: IslandProblem, answer: Array, linear: bool = False) -> Found | None:
        """What an answer leads to; None where the plant cannot carry it."""
        try:
            return self.grid.follow(asked, answer, linear)
        except SimulationError:
            return None

    @staticmethod
    def shapes(case: Case, training: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """See `TrainedPolicy.shapes`."""
        for name, most in (("rounds", 999), ("iterations", 999), ("mending", 999), ("substeps", 8)):
            count = training.get(name, 1 if name == "substeps" else None)
            if not (isinstance(count, int) and 0 < count <= most):
                raise ValueError(f"number of {name} is missing or mistyped")
        return {"settings": (len(SETTINGS),)}


class IslandSolver:
    """The policy as a method; in operation what is not measured comes from a simulation of its last plan."""

    def __init__(self, policy: IslandPolicy, further: int) -> None:
        self._policy, self._further = policy, further
        self._estimate = StateEstimate(policy.grid.plant)
        warm_up(policy.scope, self)

    def __call__(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Answer; `last` is the plan in force."""

        def powers(instance: Instance) -> Array:
            in_force = None if last is None else last.schedule
            state = self._estimate.initial(instance, in_force)
            found = self._policy.powers(instance, self._further, state, in_force)
            self._estimate.keep(instance, state, Schedule(self._policy.knots, found))
            return found

        return answered(self._policy, powers, self._further, instance)

    solve = __call__
