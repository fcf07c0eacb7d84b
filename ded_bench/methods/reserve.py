"""Reserve: room for generators to follow the steepest ramp of a load that nobody announced.

A load that ramps turns the machines around it. Generators near it can follow the load; where all of them
stand at a limit, as a static dispatch has them, none can, and no plan is fast enough. So at every knot, for
both directions of each ramp, a response is asked for: ramps δ of the generators that go on as long as the
load's, stay within their limits, and leave every machine a steady speed within `limit`,

    |K (δ - T λ)| <= limit + e,    p_min <= P + τ δ <= p_max,    |δ| <= ramp,    e >= 0

with K the compliance S⁻¹ and T the loads' shares (`Network.linearise`) at the nominal point of the lossless
network, λ the load's ramp and τ its duration. The shortage e has a price.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ded_bench.plants.lossless.network import Network
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array, Case
from ded_bench.solvers.linear_program import FreeForm

#: Steady speed that a ramp may leave, as a part of the bound: a ramp that begins at once swings a machine to
#: twice its steady speed. This and the price were chosen on scenarios drawn for it (docs/online.md).
LIMIT = 0.5
#: What a shortage as large as that costs, in pu of generation at the mean cost of all machines.
PRICE = 1.0
#: Knots so far ahead keep reserve, s: plans are made anew long before.
AHEAD_S = 20.0


@dataclass(frozen=True, eq=False)
class Reserve:
    """The ramps that plans of one case must be able to follow."""

    case: Case
    speeds: Array  # steady speeds under each ramp if nobody follows, (n_ramps, n_gen), rad/s
    compliance: Array  # K, (n_gen, n_gen), rad/pu
    limit: float  # rad/s
    duration_s: float  # τ
    price: float = PRICE
    ahead_s: float = AHEAD_S

    @staticmethod
    def of(case: Case, limit: float) -> Reserve:
        """The steepest ramps of a case, up and down, that turn a machine too fast if nobody follows.

        Args:
            case: gives the loads' ranges (`sampling`).
            limit: of steady speeds, rad/s.
        """
        network = Network(case)
        linear = network.linearise(network.power_flow(case.p_nominal, case.load_nominal))
        compliance = np.asarray(np.linalg.inv(linear.stiffness), dtype=np.float64)
        speeds = (compliance @ linear.share * np.abs(case.load_rate).max(axis=0)).T
        fast = speeds[np.abs(speeds).max(axis=1) > limit]
        duration = float(np.mean(case.sampling.duration_s))
        return Reserve(case, np.concatenate([fast, -fast]), compliance, limit, duration)

    def required(
        self, form: FreeForm, power: Indices, p_gen: Array, after: Indices, price: Array
    ) -> tuple[FreeForm, Indices]:
        """A program with a response to every ramp at some knots.

        Args:
            form: the program.
            power: its columns of powers less `p_gen`, at these knots, (n_knots, n_gen).
            p_gen: pu, likewise.
            after: the column after which those of a knot are to stand, (n_knots,).
            price: of a shortage of 1 rad/s at each knot, (n_knots,).

        Returns:
            The program, and where the columns of `form` stand in it.
        """
        (n_knots, n_gen), n_ramps = power.shape, len(self.speeds)
        count, ramp = n_knots * n_ramps, self.case.ramp
        cost = np.zeros((count, n_gen + 1))
        cost[:, -1] = np.repeat(price, n_ramps)
        form, place, new = form.with_columns(
            np.repeat(after, n_ramps * (n_gen + 1)),
            cost.ravel(),
            np.tile(np.append(-ramp, 0.0), count),
            np.tile(np.append(ramp, np.inf), count),
        )
        response, shortage = np.split(new.reshape(count, n_gen + 1), [n_gen], axis=1)

        def rows(columns: Indices, values: Array) -> sp.csc_matrix:
            """One row for each response and generator; columns and values are (count, n_gen, any)."""
            row = np.broadcast_to(np.arange(count * n_gen).reshape(count, n_gen, 1), columns.shape)
            entries = np.broadcast_to(values, columns.shape).ravel()
            return sp.csc_matrix((entries, (row.ravel(), columns.ravel())), (count * n_gen, len(form.cost)))

        every = (count, n_gen, n_gen)
        speed = rows(np.broadcast_to(response[:, None, :], every), self.compliance)
        short = rows(np.broadcast_to(shortage[:, :, None], (count, n_gen, 1)), np.ones(1))
        at_knot = np.repeat(place[power], n_ramps, axis=0)
        room = rows(np.stack([at_knot, response], axis=2), np.array([1.0, self.duration_s]))
        alone = np.tile(self.speeds, (n_knots, 1)).ravel()
        planned = np.repeat(p_gen, n_ramps, axis=0)
        free = np.full(alone.shape, np.inf)
        wider = form.with_rows(
            sp.vstack([speed - short, speed + short, room]),
            np.concatenate([-free, -self.limit - alone, (self.case.p_min - planned).ravel()]),
            np.concatenate([self.limit - alone, free, (self.case.p_max - planned).ravel()]),
        )
        return wider, place
