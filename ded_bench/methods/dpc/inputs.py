"""What `ded-dpc` sees of instances: stacked arrays, and channels over the knots made from them.

Angles at t = 0 that are those of an equilibrium follow from P_0 and the initial loads, so that no power
flow has to be solved; where an instance gives others, their deviation counts. Loads enter as forecasts
at the knots, with their bend between two knots, and as the static dispatch that they would have if
nothing had inertia; what loads and initial state do to frequency and slack power is in `response`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.dpc.kernels import (
    ChannelArrays,
    InstanceArrays,
    PowerLimits,
    fill_loads,
    fill_machines,
)
from ded_bench.methods.dpc.response import Array32, Response
from ded_bench.methods.ramp_follower import track
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, LoadPoints, LoadRamp

#: A segment that no path reaches: it starts later than any horizon ends, s.
NEVER = (1e30, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Inputs:
    """Instances of one case as stacked arrays, in the units of the files.

    A load's path is a row of segments (start in s, injection there in pu, slope in pu/s); the rest of
    the row is filled with segments that start at `NEVER`.
    """

    load: Array  # segments, (batch, n_load, n_segments, 3)
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu
    state: Array  # (δθ, ω) at t = 0, (batch, 2 n_gen), rad and rad/s; see `_initial_state`

    @staticmethod
    def of(case: Case, instances: Sequence[Instance]) -> Inputs:
        """Stack instances.

        Raises:
            PowerFlowError: an instance gives angles at t = 0, but there is no equilibrium to compare with.
        """
        machines = (case.slack, *case.generators)
        paths = [_segments(i.load[bus]) for i in instances for bus in case.loads]
        longest = max(map(len, paths), default=0)
        flat = [number for path in paths for number in path + NEVER * ((longest - len(path)) // 3)]
        return Inputs(
            np.array(flat).reshape(len(instances), len(case.loads), longest // 3, 3),
            np.array([[i.cost[bus] for bus in machines] for i in instances]),
            np.array([[i.initial.power[bus] for bus in case.generators] for i in instances]),
            np.array([_initial_state(case, i) for i in instances]),
        )

    def __len__(self) -> int:
        return len(self.load)

    def __getitem__(self, rows: slice) -> Inputs:
        return Inputs(self.load[rows], self.cost[rows], self.p_initial[rows], self.state[rows])

    @property
    def omega(self) -> Array:
        """ω(0), (batch, n_gen), rad/s."""
        return self.state[:, self.p_initial.shape[1] :]

    def p_load(self, times: Array) -> Array:
        """Load injections, shape (batch, n_times, n_load), pu."""
        start, value, slope = (self.load[:, None, :, :, i] for i in range(3))
        found = np.broadcast_to(value[..., 0], (len(self), len(times), self.load.shape[1]))
        for k in range(self.load.shape[2]):
            since = times[:, None] - start[..., k]
            found = np.where(since < 0.0, found, value[..., k] + slope[..., k] * since)
        return found


def _segments(load: LoadRamp | LoadPoints) -> tuple[float, ...]:
    """(start, injection there, slope) of each linear piece of a load's path, one after another."""
    if isinstance(load, LoadRamp):
        initial, start, duration, rate = load.initial, load.start, load.duration, load.rate
        return 0.0, initial, 0.0, start, initial, rate, start + duration, initial + rate * duration, 0.0
    path: list[float] = []
    for (t, p), (t_next, p_next) in itertools.pairwise(load.points):
        path += [t, p, (p_next - p) / (t_next - t)]
    return tuple(path)


def _initial_state(case: Case, instance: Instance) -> list[float]:
    """δθ, by which θ(0) is off the equilibrium of P_0 and the initial loads, then ω(0), (2 n_gen,).

    δθ is zero unless the instance gives angles; only then a power flow has to be solved.
    """
    omega = [instance.initial.omega[bus] for bus in case.generators]
    theta = instance.theta_initial(case)
    if theta is None:
        return [0.0] * len(omega) + omega
    network = Network(case)
    p_load = instance.p_load(case, np.zeros(1))[0]
    equilibrium = network.power_flow(instance.p_initial(case), p_load)
    return [*(theta - equilibrium[network.generators]).tolist(), *omega]


@dataclass(frozen=True, eq=False)
class Channels:
    """What the network reads of instances, not yet normalised, and the schedule that it corrects first.

    In memory the channel comes before the knot.
    """

    sequence: Array  # (batch, n_knots, n_sequence), see `sequence_groups`
    constants: Array  # (batch, n_constants)
    start: Array  # schedule to correct, (batch, n_knots, n_gen), pu
    free_response: Array32  # see `Response.free_response`

    @staticmethod
    def of(case: Case, inputs: Inputs, response: Response, dispatch: bool = True) -> Channels:
        """Compute the channels at the knots of a response.

        The first schedule follows the static dispatch of the loads at each knot, or, without
        `dispatch`, the middle of the generators' range.
        """
        knots, nodes, batch = response.knots, response.nodes, len(inputs)
        n_sequence, n_constants = n_channels(case)
        channels = ChannelArrays(
            p_load=np.empty((batch, len(case.loads), len(nodes))),
            sequence=np.empty((batch, n_sequence, len(knots))),
            constants=np.empty((batch, n_constants)),
            start=np.empty((batch, len(case.generators), len(knots))),
        )
        given = InstanceArrays(inputs.cost, inputs.p_initial, inputs.state)
        limits = PowerLimits(case.p_min, case.p_max)
        fill_loads(inputs.load, nodes, channels.p_load, channels.sequence)
        at_knots = channels.sequence[:, : len(case.loads)].swapaxes(1, 2)
        static = merit_order(case, inputs.cost[:, None, 1:], inputs.cost[:, :1], at_knots)
        fill_machines(given, static, limits, dispatch, channels)
        track(channels.start, case.ramp * (knots[1] - knots[0]))
        p_load, sequence, constants, start = channels
        free = response.free_response(inputs.state, p_load.swapaxes(1, 2))
        return Channels(sequence.swapaxes(1, 2), constants, start.swapaxes(1, 2), free)

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
