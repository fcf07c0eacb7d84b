"""What `ded-dpc` sees of instances: stacked arrays, and channels over the knots made from them.

The angles at t = 0 are no input: they follow from P_0 and the initial loads, which are, so that no
power flow has to be solved. Loads enter as forecasts at the knots, with their bend between two
knots, and as the static dispatch that they would have if nothing had inertia; what they do to
frequency and slack power is in `response`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.dpc.kernels import fill
from ded_bench.methods.dpc.response import Array32, Response
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance


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
        ramps = [[(r.initial, r.start, r.duration, r.rate) for r in i.ramps(case)] for i in instances]
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
        step = case.ramp * (knots[1] - knots[0])
        given = inputs.ramps, inputs.cost, inputs.p_initial, inputs.omega
        limits = case.p_min, case.p_max, step
        fill(*given, nodes, *limits, dispatch, p_load, sequence, constants, start)
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
