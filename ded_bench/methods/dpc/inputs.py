"""What `ded-dpc` sees of instances: stacked arrays, and channels over the knots made from them.

The angles at t = 0 are no input: they follow from P_0 and the initial loads, which are, so that no
power flow has to be solved. Loads enter as forecasts at the knots, with their bend between two
knots, and as the static dispatch that they would have if nothing had inertia; what they do to
frequency and slack power is in `response`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from ded_bench.methods.dpc.follower import track
from ded_bench.methods.dpc.response import Array32, Response
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance

#: Costs whose sum is smaller are as good as free.
SMALLEST_SUM = 1e-9


@dataclass(frozen=True, eq=False)
class Inputs:
    """Instances of one case as stacked arrays, in the units of the files."""

    ramps: Array  # initial (pu), start (s), duration (s), rate (pu/s); (batch, n_load, 4)
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu
    omega: Array  # ω(0), (batch, n_gen), rad/s

    @staticmethod
    def of(case: Case, instances: Sequence[Instance]) -> Inputs:
        """Stack instances."""
        machines = (case.slack, *case.generators)
        ramps = [
            [(r.initial, r.start, r.duration, r.rate) for r in (i.load[bus] for bus in case.loads)]
            for i in instances
        ]
        return Inputs(
            np.array(ramps),
            np.array([[i.cost[bus] for bus in machines] for i in instances]),
            np.array([[i.initial.power[bus] for bus in case.generators] for i in instances]),
            np.array([[i.initial.omega[bus] for bus in case.generators] for i in instances]),
        )

    def __len__(self) -> int:
        return len(self.ramps)

    def __getitem__(self, rows: slice) -> Inputs:
        return Inputs(self.ramps[rows], self.cost[rows], self.p_initial[rows], self.omega[rows])

    def p_load(self, times: Array) -> Array:
        """Load injections, shape (batch, n_times, n_load), pu."""
        initial, start, duration, rate = (self.ramps[:, None, :, i] for i in range(4))
        into = np.minimum(np.maximum(times[:, None] - start, 0.0), duration)
        return np.asarray(initial + rate * into)


@dataclass(frozen=True, eq=False)
class Channels:
    """What the network reads of instances, not yet normalised, and the schedule that it corrects first.

    In memory the channel comes before the knot.
    """

    sequence: Array  # (batch, n_knots, n_sequence), see `sequence_groups`
    constants: Array  # (batch, n_constants)
    start: Array  # schedule to correct, (batch, n_knots, n_gen), pu
    undriven: Array32  # see `Response.undriven`

    @staticmethod
    def of(case: Case, inputs: Inputs, response: Response, dispatch: bool = True) -> Channels:
        """Compute the channels at the knots of a response.

        The first schedule follows the static dispatch of the loads at each knot, or, without
        `dispatch`, the middle of the generators' range.
        """
        knots, nodes, batch = response.knots, response.nodes, len(inputs)
        n_sequence, n_constants = n_channels(case)
        p_load = np.empty((batch, len(case.loads), len(nodes)))
        sequence = np.empty((batch, n_sequence, len(knots)))
        constants = np.empty((batch, n_constants))
        start = np.empty((batch, len(case.generators), len(knots)))
        step = float(case.ramp_pu_per_s * (knots[1] - knots[0]))
        given = inputs.ramps, inputs.cost, inputs.p_initial, inputs.omega
        limits = case.p_min, case.p_max, step
        _fill(*given, nodes, *limits, dispatch, p_load, sequence, constants, start)
        undriven = response.undriven(inputs.omega, p_load.swapaxes(1, 2))
        return Channels(sequence.swapaxes(1, 2), constants, start.swapaxes(1, 2), undriven)

    def static_cost(self, inputs: Inputs) -> Array:
        """Cost of the static dispatch, mean over the knots, shape (batch,): the instance's own scale."""
        p_slack = self.sequence[:, :, -1]
        n_gen = inputs.cost.shape[1] - 1
        cost = self.sequence[:, :, -1 - n_gen : -1] @ inputs.cost[:, 1:, None]
        return np.asarray((cost[:, :, 0] + inputs.cost[:, :1] * np.abs(p_slack)).mean(axis=1))


def n_channels(case: Case) -> tuple[int, int]:
    """Number of channels of the sequence and of constants."""
    n_gen, n_load = len(case.generators), len(case.loads)
    return 2 * n_load + n_gen + 1, (1 + n_gen) + n_gen + n_gen * (n_gen - 1) // 2 + 2 * n_gen


def sequence_groups(case: Case) -> dict[str, slice]:
    """Where in the sequence which channels stand."""
    n_gen, n_load = len(case.generators), len(case.loads)
    return {
        "loads": slice(0, n_load),
        "bends": slice(n_load, 2 * n_load),
        "dispatch": slice(2 * n_load, 2 * n_load + n_gen + 1),
    }


@numba.njit(cache=True, nogil=True)
def _fill(
    ramps: Array,
    cost: Array,
    p_initial: Array,
    omega: Array,
    nodes: Array,
    p_min: Array,
    p_max: Array,
    step: float,
    dispatch: bool,
    p_load: Array,
    sequence: Array,
    constants: Array,
    start: Array,
) -> None:
    """Compute the last four, instance by instance; see `Inputs` and `Channels`."""
    n_gen, n_load = len(p_min), p_load.shape[1]
    for b in range(len(ramps)):
        for i in range(n_load):
            _loads_and_bends(ramps[b, i], nodes, p_load[b, i], sequence[b, i], sequence[b, n_load + i])
        static = sequence[b, 2 * n_load :]
        _dispatch(sequence[b, :n_load], cost[b], p_min, p_max, static)
        _constants(cost[b], p_initial[b], omega[b], constants[b])
        for g in range(n_gen):
            for j in range(1, start.shape[2]):
                start[b, g, j] = static[g, j] if dispatch else 0.5 * (p_min[g] + p_max[g])
            start[b, g, 0] = p_initial[b, g]
        track(start[b], step, start[b])


@numba.njit(cache=True, nogil=True)
def _loads_and_bends(ramp: Array, nodes: Array, p_load: Array, at_knots: Array, bends: Array) -> None:
    """A load at the nodes and at the knots, and how far its mean between two knots is off the chord; pu.

    Every second node is a knot. The bend tells where between two knots a ramp starts or ends.
    """
    initial, begin, duration, rate = ramp
    spacing = nodes[2] - nodes[0]
    last_area = last_half = 0.0
    for k in range(len(nodes)):
        since = max(nodes[k] - begin, 0.0)
        into = min(since, duration)
        p_load[k] = initial + rate * into
        if k % 2 == 0:
            half = 0.5 * into
            area = into * (since - half)  # ∫ into dt
            at_knots[k // 2] = p_load[k]
            bends[k // 2] = rate * ((area - last_area) / spacing - half - last_half) if k else 0.0
            last_area, last_half = area, half


@numba.njit(cache=True, nogil=True)
def _dispatch(p_load: Array, cost: Array, p_min: Array, p_max: Array, static: Array) -> None:
    """`problem.dispatch.merit_order` at each knot, then the slack's power; pu.

    Args:
        p_load: loads at the knots, (n_load, n_knots).
        cost: (slack, generators), (1 + n_gen,).
        static: receives the powers, (n_gen + 1, n_knots).
    """
    (n_load, n), n_gen = p_load.shape, len(p_min)
    for j in range(n):
        static[n_gen, j] = 0.0
        for i in range(n_load):
            static[n_gen, j] -= p_load[i, j]
    for g in range(n_gen):
        own, below = cost[1 + g], 0.0  # below: what all must deliver, and those that come earlier can
        for i in range(n_gen):
            below += p_min[i]
            other = cost[1 + i]
            if other < cost[0] and (other < own or (other == own and i < g)):
                below += p_max[i] - p_min[i]
        room = p_max[g] - p_min[g] if own < cost[0] else 0.0
        for j in range(n):
            static[g, j] = p_min[g] + min(max(static[n_gen, j] - below, 0.0), room)
    for g in range(n_gen):
        for j in range(n):
            static[n_gen, j] -= static[g, j]


@numba.njit(cache=True, nogil=True)
def _constants(cost: Array, p_initial: Array, omega: Array, constants: Array) -> None:
    """Ratios of costs, then P_0 and ω(0).

    Each cost in all costs, each generator's in its and the slack's, and of each pair of generators the
    difference in the sum.
    """
    n_gen, k, total = len(p_initial), 0, 0.0
    for i in range(1 + n_gen):
        total += cost[i]
    for i in range(1 + n_gen):
        constants[k] = cost[i] / max(total, SMALLEST_SUM)
        k += 1
    for i in range(1, 1 + n_gen):
        constants[k] = cost[i] / max(cost[i] + cost[0], SMALLEST_SUM)
        k += 1
    for i in range(1, 1 + n_gen):
        for j in range(i + 1, 1 + n_gen):
            constants[k] = (cost[i] - cost[j]) / max(cost[i] + cost[j], SMALLEST_SUM)
            k += 1
    for g in range(n_gen):
        constants[k + g], constants[k + n_gen + g] = p_initial[g], omega[g]
