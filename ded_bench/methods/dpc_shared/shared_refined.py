"""DED-DPC, refined (`ded-dpc-shared-refined`): a few small linear programs correct the policy's answer."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.dpc_shared import shared_policy
from ded_bench.methods.dpc_shared.drawn_problems import Problems
from ded_bench.methods.dpc_shared.grid_response import GridResponse, largest_divisor
from ded_bench.methods.dpc_shared.path_model import Linear, Outset
from ded_bench.methods.dpc_shared.path_program import PathProgram
from ded_bench.methods.dpc_shared.shared_policy import SharedPolicy
from ded_bench.methods.dpc_shared.stage_kernels import track_rows
from ded_bench.methods.policy_solver import VERSION, warmed_up
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.piqp import solve_form
from ded_bench.solvers.status import Status

METHOD = "ded-dpc-shared-refined"
#: Whether the policy gives the schedule to start from; else it is the one that the policy starts from.
SETTINGS: Mapping[str, Mapping[str, Any]] = {"default": {"learned": True}, "unlearned": {"learned": False}}
#: Most paths along which the grid is linearised, and most programs around each.
PATHS, PROGRAMS = 4, 2
#: Time from one correction to the next, at most, s; where limits of |ω| cannot hold so, every knot has one.
SPACING_S = 1.3
#: By what part the bound is tightened, of what the fastest mode can rise between two fine points.
MARGIN = 0.45
#: |ω| is limited where it exceeds these parts of the bound: under the first schedule, under others.
FIRST, NEAR = 0.5, 0.8
#: Relative excess of |ω| that needs no further program, nor a further path.
OPEN, OFF = 2e-3, 0.04
REGULARISATION = 1e-9
#: Relative duality gap and residuals of a program that are small enough (docs/model.md).
GAP, RESIDUAL = 1e-3, 1e-4


@dataclass(frozen=True, eq=False)
class Refiner:
    """Corrects schedules of one case and regime."""

    policy: SharedPolicy
    learned: bool
    bound: float  # tightened, rad/s

    def __call__(self, instance: Instance) -> tuple[Schedule, int]:
        """A schedule on the policy's knots, and iterations of all programs.

        Raises:
            InputError: the instance belongs to another case or horizon, or its loads cannot be served.
        """
        policy, model = self.policy, self.policy.model
        outset = model.outset(policy.problems([instance]))
        linear = model.linearise(outset, model.start_path(outset))
        answer = policy.answer(outset, linear) if self.learned else outset.start
        apart, iterations = knots_between(policy.knots), 0
        attempts = [(answer, knots) for knots in sorted({apart, 1}, reverse=True)]
        attempts += [(outset.start, 1)] if self.learned else []
        for start, knots in attempts:
            powers, needed = self._corrected(outset, linear, start, knots, widen=knots == 1)
            iterations += needed
            if powers is not None:
                return Schedule(policy.knots, powers[0]), iterations
        return Schedule(policy.knots, answer[0]), iterations

    def _corrected(
        self, outset: Outset, linear: Linear, powers: Array, knots: int, widen: bool
    ) -> tuple[Array | None, int]:
        """Corrected powers and iterations; None: a program has no solution that is found.

        Args:
            outset: of one problem.
            linear: along its first path.
            powers: at the knots, (1, n_knots, n_gen), pu.
            knots: from one correction to the next.
            widen: where limits of |ω| cannot hold they are widened.
        """
        model, iterations = self.policy.model, 0
        limited: NDArray[np.bool_] | bool = False
        for number in range(PATHS):
            linear = model.along(outset, model.respond(powers, outset, linear)[0])
            program = PathProgram(model, outset, linear, powers, knots, self.bound)
            if number and not program.near(1.0 + OFF).any():
                break
            limited = limited | program.near(NEAR if number else FIRST)
            for _ in range(PROGRAMS):
                found, needed = self._solved(program, limited, widen)
                iterations += needed
                if found is None:
                    return None, iterations
                corrected = found
                if not (program.near(1.0 + OPEN, found) & ~limited).any():
                    break
                limited = limited | program.near(NEAR, found)
            powers = self._within_limits(corrected, outset.problems)
        return powers, iterations

    @staticmethod
    def _solved(program: PathProgram, limited: NDArray[np.bool_], widen: bool) -> tuple[Array | None, int]:
        """Corrected powers or None, and iterations."""
        iterations = 0
        for widened in (False, True) if widen else (False,):
            form = program.form(limited, widened)
            answer = solve_form(form, staged=True, regularisation=REGULARISATION, gap=GAP, residual=RESIDUAL)
            iterations += answer.iterations
            if answer.status == Status.OPTIMAL:
                return program.corrected(answer.x, widened), iterations
        return None, iterations

    def _within_limits(self, powers: Array, problems: Problems) -> Array:
        """Powers that keep bounds, ramps and P_0 to the last bit."""
        case = self.policy.scope.case
        powers[:, 0] = problems.p_initial
        track_rows(powers, case.p_min, case.p_max, self.policy.model.ramp)
        return powers


def knots_between(knots: Array) -> int:
    """Intervals from one correction to the next: as many as `SPACING_S` allows, of those that divide all."""
    return largest_divisor(len(knots) - 1, SPACING_S / (knots[1] - knots[0]))


def margin_of(response: GridResponse) -> float:
    """By what part the bound is tightened on a grid."""
    network = response.network
    squares = np.linalg.eigvalsh(response.stiffness / np.sqrt(np.outer(network.m, network.m)))
    return float(MARGIN * (1.0 - np.cos(0.5 * np.sqrt(squares.max()) * response.fine[1])))


def artifacts(case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
    """The policy that `prepare` would use."""
    return shared_policy.artifacts(case, regime, _plain(settings))


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the refined policy as a method."""
    policy = shared_policy.find_policy(case, regime, _plain(settings))
    bound = (1.0 - margin_of(policy.model.response)) * case.omega_bound(regime)
    refiner = Refiner(policy, SETTINGS[settings.name]["learned"], bound)

    def solve(instance: Instance) -> Solution:
        started = time.perf_counter()
        schedule, iterations = refiner(instance)
        elapsed = time.perf_counter() - started
        return Solution(Status.POLICY, schedule, iterations, solve_s=elapsed, solver_version=VERSION)

    return warmed_up(solve, policy.scope)


def _plain(settings: Settings) -> Settings:
    """Of the policy: it is the one of the default training, whatever refines it."""
    return dataclasses.replace(settings, name="default")
