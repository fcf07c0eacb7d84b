"""What a schedule would do to frequency and slack power: the linearised grid, condensed on the knots.

`ded-dpc` looks at this before it corrects a schedule. The linearisation needs no data, so that a
policy file holds no model; whatever model the policy is trained on, its network learns what the
linearisation misses.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.condensed import hat_functions
from ded_bench.surrogates.linear import linear_model

Array32 = NDArray[np.float32]


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
        psi[:n_gen] += model.lift[:, len(case.buses) + Network(case).generators].T
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
            state: (δθ, ω) at t = 0, (batch, 2 n_gen), rad and rad/s; see `inputs.Inputs`.
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
