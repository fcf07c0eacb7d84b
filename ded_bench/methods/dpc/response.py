"""What a schedule would do to frequency and slack power: the linearised grid, condensed on the knots.

`ded-dpc` looks at this before it corrects a schedule. The linearisation needs no data, so that a
policy file holds no model; whatever model the policy is trained on, its network learns what the
linearisation misses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.koopman.model import hat_functions
from ded_bench.koopman.physics import linear_model
from ded_bench.problem.case import Array, Case

Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Response:
    """(ω, P_s) at each knot and halfway before it, linear in ω(0), loads and powers.

    At t = 0 the grid is in equilibrium but for ω(0), so that no power flow has to be solved. Loads
    count as linear between nodes, powers between knots.
    """

    knots: Array  # (n_knots,), s
    nodes: Array  # the knots and the points halfway between them, (2 n_knots - 1,), s
    n_outputs: int  # per knot: n_gen + 1 at the knot, as many halfway before it
    # rows: outputs, then knots; columns: inputs, then nodes or knots
    of_omega: Array32  # (n_outputs n_knots, n_gen)
    of_load: Array32  # (n_outputs n_knots, n_load n_nodes)
    of_power: Array32  # (n_outputs n_knots, n_gen n_knots)

    @staticmethod
    def make(case: Case, knots: Array) -> Response:
        """Condense the linearisation at the nominal point; knots are equidistant."""
        n_gen, n_load, n_knots = len(case.generators), len(case.loads), len(knots)
        nodes = np.linspace(knots[0], knots[-1], 2 * n_knots - 1)
        model = linear_model(case, float(nodes[1]))
        n_omega, n_loads, n_powers = n_gen, len(nodes) * n_load, n_knots * n_gen
        inputs = np.zeros((len(nodes), n_omega + n_loads + n_powers, n_gen + n_load))
        loads = inputs[:, n_omega : n_omega + n_loads].reshape(len(nodes), n_load, len(nodes), -1)
        for i in range(n_load):
            loads[:, i, :, n_gen + i] = np.eye(len(nodes))
        powers = inputs[:, n_omega + n_loads :].reshape(len(nodes), n_gen, n_knots, -1)
        for i in range(n_gen):
            powers[:, i, :, i] = hat_functions(nodes, knots)
        psi = inputs[0] @ model.b.T
        psi[:n_omega, :n_gen] += np.eye(n_gen)
        outputs = model.rollout(psi, inputs)[:, :, : n_gen + 1]
        before = np.concatenate([outputs[:1], outputs[1::2]])
        seen = np.stack([outputs[::2], before])  # (2, n_knots, units, n_gen + 1)
        matrix = seen.transpose(0, 3, 1, 2).reshape(-1, seen.shape[2]).astype(np.float32)
        parts = np.split(matrix, [n_omega, n_omega + n_loads], axis=1)
        return Response(knots, nodes, 2 * (n_gen + 1), *map(np.ascontiguousarray, parts))

    def undriven(self, omega: Array, p_load: Array) -> Array32:
        """What ω(0) and the loads would do without generators, (batch, n_knots, n_outputs).

        Args:
            omega: ω(0), (batch, n_gen), rad/s.
            p_load: load injections at the nodes, (batch, n_nodes, n_load), pu.
        """
        outputs = self.of_omega @ omega.T.astype(np.float32)
        outputs += self.of_load @ _stacked(p_load)
        return self._by_instance(outputs)

    def __call__(self, undriven: Array32, p_gen: Array) -> Array32:
        """ω (rad/s) and P_s (pu) at each knot, then halfway before it, (batch, n_knots, n_outputs).

        Args:
            undriven: see there.
            p_gen: powers at the knots, (batch, n_knots, n_gen), pu.
        """
        return undriven + self._by_instance(self.of_power @ _stacked(p_gen))

    def _by_instance(self, outputs: Array32) -> Array32:
        """From (n_outputs n_knots, batch) to (batch, n_knots, n_outputs)."""
        return outputs.reshape(self.n_outputs, len(self.knots), -1).T


def _stacked(values: Array) -> Array32:
    """From (batch, n, n_columns) to (n_columns n, batch), in float32."""
    return values.T.reshape(-1, len(values)).astype(np.float32)
