"""What the network of `ded-dpc` reads: channels over the knots, and what a schedule would do.

Loads enter as forecasts at the knots, with their bend between two knots, and as the static dispatch that
they would have if nothing had inertia. What loads, initial state and a schedule do to frequency and slack
power is told by the linearised grid, condensed on the knots (`Response`). The linearisation needs no data, so
that a policy file holds no model; what it misses the network learns from the model that it is trained on.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.knots import track
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Array, Case
from ded_bench.problem.compiled import compiled, copy_row
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.quantities import Array32
from ded_bench.surrogates.koopman import hat_functions
from ded_bench.surrogates.linear import by_angles, linear_model

#: Costs whose sum is smaller are as good as free.
SMALLEST_SUM = 1e-9


@dataclass(frozen=True, eq=False)
class Response:
    """(ω, P_s) at each knot and halfway before it, linear in the initial state, loads and powers.

    Angles at t = 0 count by their deviation δθ from the equilibrium of P_0 and the initial loads. Loads
    count as linear between nodes, powers between knots.
    """

    knots: Array  # (n_knots,), s
    nodes: Array  # the knots and the points halfway between them, (2 n_knots - 1,), s
    n_outputs: int  # per knot: n_gen + 1 at the knot, as many halfway before it
    of_state: Array32  # (2 n_gen, n_outputs n_knots)
    of_load: Array32  # (n_load n_nodes, n_outputs n_knots)
    of_power: Array32  # (n_gen n_knots, n_outputs n_knots)

    @staticmethod
    def make(case: Case, knots: Array) -> Response:
        """Condense the linearisation at the nominal point; knots are equidistant."""
        n_gen, n_load, n_knots = len(case.generators), len(case.loads), len(knots)
        nodes = np.linspace(knots[0], knots[-1], 2 * n_knots - 1)
        model = linear_model(case, float(nodes[1]))
        sections = np.cumsum([0, 2 * n_gen, len(nodes) * n_load, n_knots * n_gen]).tolist()
        state, loads, powers = (slice(a, b) for a, b in itertools.pairwise(sections))
        inputs = np.zeros((len(nodes), sections[-1], n_gen + n_load))
        unit_loads = inputs[:, loads].reshape(len(nodes), n_load, len(nodes), -1)
        for i in range(n_load):
            unit_loads[:, i, :, n_gen + i] = np.eye(len(nodes))
        unit_powers = inputs[:, powers].reshape(len(nodes), n_gen, n_knots, -1)
        for i in range(n_gen):
            unit_powers[:, i, :, i] = hat_functions(nodes, knots)
        psi = inputs[0] @ model.b.T
        psi[:n_gen] += by_angles(case).T
        psi[n_gen : 2 * n_gen, :n_gen] += np.eye(n_gen)
        outputs = model.rollout(psi, inputs)[:, :, : n_gen + 1]
        before = np.concatenate([outputs[:1], outputs[1::2]])
        seen = np.stack([outputs[::2], before])  # (2, n_knots, units, n_gen + 1)
        matrix = seen.transpose(2, 0, 3, 1).reshape(seen.shape[2], -1).astype(np.float32)
        parts = (matrix[section] for section in (state, loads, powers))
        return Response(knots, nodes, 2 * (n_gen + 1), *parts)

    def free_response(self, state: Array, p_load: Array) -> Array32:
        """What initial state and loads do without generator power, (batch, n_knots, n_outputs).

        Args:
            state: (δθ, ω) at t = 0, (batch, 2 n_gen), rad and rad/s.
            p_load: load injections at the nodes, (batch, n_nodes, n_load), pu.
        """
        outputs = state.astype(np.float32) @ self.of_state
        outputs += _by_column(p_load) @ self.of_load
        return self._by_knot(outputs)

    def __call__(self, free: Array32, p_gen: Array) -> Array32:
        """ω (rad/s) and P_s (pu) at each knot, then halfway before it, (batch, n_knots, n_outputs).

        Args:
            free: the free response.
            p_gen: powers at the knots, (batch, n_knots, n_gen), pu.
        """
        return free + self._by_knot(_by_column(p_gen) @ self.of_power)

    def _by_knot(self, outputs: Array32) -> Array32:
        """From (batch, n_outputs n_knots) to (batch, n_knots, n_outputs)."""
        return outputs.reshape(len(outputs), self.n_outputs, -1).swapaxes(1, 2)


def _by_column(values: Array) -> Array32:
    """From (batch, n, n_columns) to (batch, n_columns n), in float32."""
    return values.swapaxes(1, 2).reshape(len(values), -1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Channels:
    """What the network reads of instances, not yet normalised, and the schedule that it corrects first.

    In memory the channel comes before the knot.
    """

    sequence: Array  # loads, their bends, static dispatch, its slack power, (batch, n_knots, n_sequence)
    constants: Array  # see `fill_machines`, (batch, n_constants)
    start: Array  # schedule to correct: it follows the static dispatch, (batch, n_knots, n_gen), pu
    free_response: Array32  # see `Response.free_response`

    @staticmethod
    def of(case: Case, inputs: StackedInstances, response: Response) -> Channels:
        """Compute the channels at the knots of a response."""
        knots, nodes, batch = response.knots, response.nodes, len(inputs)
        n_sequence, n_constants = n_channels(case)
        n_gen, n_load = len(case.generators), len(case.loads)
        p_load, sequence = np.empty((batch, n_load, len(nodes))), np.empty((batch, n_sequence, len(knots)))
        constants, start = np.empty((batch, n_constants)), np.empty((batch, n_gen, len(knots)))
        fill_loads(inputs.load, nodes, p_load, sequence)
        at_knots = sequence[:, :n_load].swapaxes(1, 2)
        static = merit_order(case, inputs.cost[:, None, 1:], inputs.cost[:, :1], at_knots)
        fill_machines(inputs.cost, inputs.p_initial, inputs.omega, static, sequence, constants, start)
        start = start.swapaxes(1, 2)
        track(start, case.p_min, case.p_max, case.ramp * (knots[1] - knots[0]))
        state = np.concatenate([inputs.delta, inputs.omega], axis=1)
        free = response.free_response(state, p_load.swapaxes(1, 2))
        return Channels(sequence.swapaxes(1, 2), constants, start, free)

    def static_cost(self, inputs: StackedInstances) -> Array:
        """Cost of the static dispatch, mean over the knots, shape (batch,): the instance's own scale."""
        p_slack = self.sequence[:, :, -1]
        n_gen = inputs.cost.shape[1] - 1
        cost = self.sequence[:, :, -1 - n_gen : -1] @ inputs.cost[:, 1:, None]
        return np.asarray((cost[:, :, 0] + inputs.cost[:, :1] * np.abs(p_slack)).mean(axis=1))


def n_channels(case: Case) -> tuple[int, int]:
    """Number of channels of the sequence and of constants."""
    n_gen, n_load = len(case.generators), len(case.loads)
    return 2 * n_load + n_gen + 1, (1 + n_gen) + n_gen + n_gen * (n_gen - 1) // 2 + 2 * n_gen


@compiled
def fill_loads(load: Array, nodes: Array, p_load: Array, sequence: Array) -> None:
    """Loads of a batch at the nodes, then at the knots and their bends.

    Every second node is a knot. A bend is how far a load's mean between two knots is off the chord, pu: it
    tells where between them the load changes its slope.

    Args:
        load: see `StackedInstances`.
        nodes: (n_nodes,), s.
        p_load: receives loads at the nodes, (batch, n_load, n_nodes), pu.
        sequence: receives the first channels, (batch, n_sequence, n_knots).
    """
    n_load, n_segments, spacing = p_load.shape[1], load.shape[2], nodes[2] - nodes[0]
    for b in range(len(p_load)):
        for i in range(n_load):
            segments, at_knots, bends = load[b, i], sequence[b, i], sequence[b, n_load + i]
            initial = segments[0, 1]
            following, before = 0, 0.0  # next segment, and ∫ (load - initial) dt up to the start of this one
            start = rise = slope = area_before = rise_before = 0.0
            for k in range(len(nodes)):
                while following < n_segments and segments[following, 0] <= nodes[k]:
                    width = segments[following, 0] - start
                    before += width * (rise + 0.5 * slope * width)
                    start, slope = segments[following, 0], segments[following, 2]
                    rise = segments[following, 1] - initial
                    following += 1
                since = nodes[k] - start
                change = rise + slope * since
                p_load[b, i, k] = initial + change
                if k % 2 == 0:
                    area = before + 0.5 * since * (rise + change)
                    at_knots[k // 2] = p_load[b, i, k]
                    chord = 0.5 * (change + rise_before)
                    bends[k // 2] = (area - area_before) / spacing - chord if k else 0.0
                    area_before, rise_before = area, change


@compiled
def fill_machines(
    cost: Array,
    p_initial: Array,
    omega: Array,
    static: Array,
    sequence: Array,
    constants: Array,
    start: Array,
) -> None:
    """What else a batch's channels hold, instance by instance; see `Channels`.

    Constants are ratios of costs, then P_0 and ω(0). The ratios: each cost in all costs, each generator's in
    its and the slack's, and of each pair of generators the difference in the sum.

    Args:
        cost: see `StackedInstances`; likewise `p_initial` and `omega`.
        static: static dispatch at the knots, (batch, n_knots, n_gen), pu.
        sequence: has the loads; receives the other channels, (batch, n_sequence, n_knots).
        constants: receives them, (batch, n_constants).
        start: receives P_0, then the static dispatch, (batch, n_gen, n_knots), pu.
    """
    n_gen = p_initial.shape[1]
    n_load = (sequence.shape[1] - n_gen - 1) // 2
    for b in range(len(static)):
        for j in range(start.shape[2]):
            p_slack = 0.0
            for i in range(n_load):
                p_slack -= sequence[b, i, j]
            for g in range(n_gen):
                p_gen = static[b, j, g]
                p_slack -= p_gen
                sequence[b, 2 * n_load + g, j] = start[b, g, j] = p_gen
            sequence[b, 2 * n_load + n_gen, j] = p_slack
        copy_row(p_initial[b], start[b, :, 0])
        own, of, k, total = cost[b], constants[b], 0, 0.0
        for i in range(1 + n_gen):
            total += own[i]
        for i in range(1 + n_gen):
            of[k] = own[i] / max(total, SMALLEST_SUM)
            k += 1
        for i in range(1, 1 + n_gen):
            of[k] = own[i] / max(own[i] + own[0], SMALLEST_SUM)
            k += 1
        for i in range(1, 1 + n_gen):
            for j in range(i + 1, 1 + n_gen):
                of[k] = (own[i] - own[j]) / max(own[i] + own[j], SMALLEST_SUM)
                k += 1
        for g in range(n_gen):
            of[k + g], of[k + n_gen + g] = p_initial[b, g], omega[b, g]
