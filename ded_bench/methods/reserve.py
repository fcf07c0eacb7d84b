"""Room for generators to follow a ramp of a load that nobody announced.

A load that ramps turns the machines around it. Generators near it can follow the load; where all of them
stand at a limit, as a static dispatch has them, none can, and no plan is fast enough. So at a knot at which a
ramp may begin a response is asked for: ramps δ of the generators that go on as long as the load's, stay
within their limits, and leave every machine a steady speed within `limit`,

    |K (δ - T λ)| <= limit + e,    p_min <= P + τ δ <= p_max,    |δ| <= ramp,    e >= 0

with K the compliance S⁻¹ and T the loads' shares (`Network.linearise`) at the nominal point of the lossless
network, λ the load's ramp and τ its duration. The shortage e has a price.

A ramp that begins at once swings machines beyond their steady speeds. So a *sudden* surprise asks for

    |ω + s (K (δ - T λ))| <= limit + e

with ω the plan's at the knot, s > 1, and τ the time that a swing takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.signal import lsim

from ded_bench.problem.case import Array, Case, Indices
from ded_bench.solvers.linear_program import FreeForm
from ded_bench.surrogates.linear import at_nominal_point


def steady_speeds(case: Case) -> tuple[Array, Array]:
    """How fast machines of a lossless grid turn while a load or a power ramps.

    Returns:
        Speeds -K T under ramps of 1 pu/s of each load's injection if nobody follows, (n_load, n_gen), rad/s;
        and the compliance K, (n_gen, n_gen), rad/pu.
    """
    linear = at_nominal_point(case)
    compliance = np.asarray(np.linalg.inv(linear.stiffness), dtype=np.float64)
    return -(compliance @ linear.share).T, compliance


def sudden_speeds(case: Case, t: Array) -> Array:
    """How far machines of a lossless grid swing from rest after a ramp begins that nobody follows.

    Args:
        case: the grid, at its nominal point.
        t: equally spaced, from 0, s.

    Returns:
        The largest |ω| until each time under a ramp of 1 pu/s of each load's injection,
        (n_t, n_load, n_gen), rad/s.
    """
    linear, n = at_nominal_point(case), len(case.generators)
    by_load = np.vstack([np.zeros_like(linear.share), -linear.share / linear.m[:, None]])
    to_speed, direct = np.eye(n, 2 * n, n), np.zeros((n, 1))
    found = [lsim((linear.matrix, one[:, None], to_speed, direct), t, t)[1] for one in by_load.T]
    speeds = np.stack([one.reshape(len(t), n) for one in found], axis=1)
    return np.asarray(np.maximum.accumulate(np.abs(speeds)))


@dataclass(frozen=True, eq=False)
class Room:
    """Surprises that a plan must be able to follow, each at one knot."""

    case: Case
    compliance: Array  # K, (n_gen, n_gen), rad/pu
    knot: Indices  # of all but the first, ascending, (count,)
    speeds: Array  # steady speeds under it if nobody follows, (count, n_gen), rad/s
    lasts_s: Array  # τ, (count,)
    swing: Array  # s, (count,); 1: ω counts as 0
    limit: float  # rad/s
    price: float

    def required(
        self,
        form: FreeForm,
        columns: tuple[Indices, Indices],
        at: tuple[Array, Array],
        after: Indices,
        price: Array,
    ) -> tuple[FreeForm, Indices]:
        """A program with a response to every surprise.

        Args:
            form: the program.
            columns: its columns of powers and of ω, less `at`, at all knots but the first, (n_knots, n_gen).
            at: powers, pu, and ω, rad/s, likewise.
            after: the column after which those of a knot are to stand, (n_knots,).
            price: of a shortage of 1 rad/s at each knot, (n_knots,).

        Returns:
            The program, and where the columns of `form` stand in it.
        """
        (count, n_gen), ramp, knot = self.speeds.shape, self.case.ramp, self.knot
        cost = np.zeros((count, n_gen + 1))
        cost[:, -1] = price[knot]
        form, place, new = form.with_columns(
            np.repeat(after[knot], n_gen + 1),
            cost.ravel(),
            np.tile(np.append(-ramp, 0.0), count),
            np.tile(np.append(ramp, np.inf), count),
        )
        response, shortage = np.split(new.reshape(count, n_gen + 1), [n_gen], axis=1)

        def rows(columns: Indices, values: Array) -> sp.csc_matrix:
            """One row for each response and generator; columns and values are like (count, n_gen, any)."""
            number = np.arange(count * n_gen).reshape(count, n_gen, 1)
            row, column, value = (part.ravel() for part in np.broadcast_arrays(number, columns, values))
            return sp.csc_matrix((value, (row, column)), (count * n_gen, len(form.cost)))

        power, omega = (place[c][knot][:, :, None] for c in columns)
        swing, is_sudden = self.swing[:, None, None], (self.swing > 1.0)[:, None]
        speed = rows(response[:, None, :], swing * self.compliance)
        if is_sudden.any():
            speed = speed + rows(omega, is_sudden[:, :, None].astype(float))
        short = rows(shortage[:, :, None], np.ones(1))
        lasts = np.array([np.ones(count), self.lasts_s]).T[:, None]
        room = rows(np.concatenate([power, response[:, :, None]], axis=2), lasts)
        alone = (self.swing[:, None] * self.speeds + is_sudden * at[1][knot]).ravel()
        planned = at[0][knot]
        free = np.full(alone.shape, np.inf)
        wider = form.with_rows(
            sp.vstack([speed - short, speed + short, room]),
            np.concatenate([-free, -self.limit - alone, (self.case.p_min - planned).ravel()]),
            np.concatenate([self.limit - alone, free, (self.case.p_max - planned).ravel()]),
        )
        return wider, place
