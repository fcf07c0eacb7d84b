"""What `ded-dpc` sees of instances: stacked arrays, and channels over the knots made from them.

The angles at t = 0 are no input: they follow from P_0 and the initial loads, which are, so that no
power flow has to be solved. Loads enter as forecasts at the knots, with their bend between two
knots, and as the static dispatch that they would have if nothing had inertia; what they do to
frequency and slack power is in `response`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.dpc.follower import follow
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

    In memory the batch comes last and the channel first: NumPy's loops then run over whole channels.
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
        knots, n_load, n_gen = response.knots, len(case.loads), len(case.generators)
        cost = inputs.cost.T
        p_load, bend = _loads_and_bends(inputs, response.nodes)
        at_knots = p_load[:, ::2]
        demand = -at_knots.sum(axis=0)
        static = _dispatch(case, cost, demand)
        sequence = np.empty((2 * n_load + n_gen + 1, *demand.shape))
        sequence[:n_load], sequence[n_load : 2 * n_load] = at_knots, bend
        sequence[2 * n_load : -1], sequence[-1] = static, demand - static.sum(axis=0)
        above, below = _cost_ratios(n_gen)
        ratios = (above @ cost) / np.maximum(below @ cost, 1e-9)
        targets = (
            static if dispatch else np.broadcast_to(_column(0.5 * (case.p_min + case.p_max)), static.shape)
        )
        return Channels(
            sequence.T,
            np.concatenate([ratios, inputs.p_initial.T, inputs.omega.T]).T,
            follow(targets.T[:, 1:], inputs.p_initial, float(case.ramp_pu_per_s * (knots[1] - knots[0]))),
            response.undriven(inputs.omega, p_load.T),
        )

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


def _loads_and_bends(inputs: Inputs, nodes: Array) -> tuple[Array, Array]:
    """Loads at the nodes, and how far their mean between two knots is off the chord; pu.

    Every second node is a knot. The bend tells where between two knots a ramp starts or ends; shapes
    (n_load, n_nodes, batch) and (n_load, n_knots, batch).
    """
    initial, start, duration, rate = inputs.ramps.T[:, :, None]
    since = nodes[:, None] - start
    np.maximum(since, 0.0, out=since)
    into = np.minimum(since, duration)
    half = 0.5 * into[:, ::2]
    area = since[:, ::2] - half
    area *= into[:, ::2]  # ∫ into dt
    bend = np.zeros_like(half)
    np.subtract(area[:, 1:], area[:, :-1], out=bend[:, 1:])
    bend[:, 1:] *= 1.0 / (nodes[2] - nodes[0])
    bend[:, 1:] -= half[:, 1:]
    bend[:, 1:] -= half[:, :-1]
    bend *= rate
    into *= rate
    into += initial
    return into, bend


def _dispatch(case: Case, cost: Array, demand: Array) -> Array:
    """`problem.dispatch.merit_order` for costs that are the same at all knots.

    Args:
        cost: (slack, generators), shape (1 + n_gen, batch).
        demand: shape (n_knots, batch), pu.

    Returns:
        Shape (n_gen, n_knots, batch), pu.
    """
    cost_gen, cost_slack = cost[1:], cost[:1]
    room = (cost_gen < cost_slack) * _column(case.p_max - case.p_min)[:, 0]
    # what generators that come earlier in the merit order can deliver; ties go by position
    others, own = cost_gen, cost_gen[:, None]
    earlier = np.where(_before(len(room))[:, :, None], others <= own, others < own)
    below = (earlier * room).sum(axis=1) + case.p_min.sum()
    raised: Array = demand - below[:, None]
    np.maximum(raised, 0.0, out=raised)
    np.minimum(raised, room[:, None], out=raised)
    raised += _column(case.p_min)
    return raised


def _column(values: Array) -> Array:
    """One value per generator, for arrays over (generators, knots, batch)."""
    return values[:, None, None]


@functools.cache
def _cost_ratios(n_gen: int) -> tuple[Array, Array]:
    """Numerators and denominators of ratios of costs, as matrices to multiply (slack, generators) by.

    Each cost in all costs, each generator's in its and the slack's, and of each pair of generators the
    difference in the sum.
    """
    unit = np.eye(1 + n_gen)
    slack, generators = unit[:, :1], unit[:, 1:]
    first, second = np.triu_indices(n_gen, 1)
    above = [unit, generators, generators[:, first] - generators[:, second]]
    below = [np.ones_like(unit), generators + slack, generators[:, first] + generators[:, second]]
    return np.hstack(above).T.copy(), np.hstack(below).T.copy()


@functools.cache
def _before(n_gen: int) -> np.ndarray:
    return np.tri(n_gen, k=-1, dtype=bool)
