"""What a schedule would do to frequency and slack power: the linearised grid, condensed on the knots.

`ded-dpc` looks at this before it corrects a schedule. The linearisation needs no data, so that a
policy file holds no model; whatever model the policy is trained on, its network learns what the
linearisation misses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ded_bench.koopman.condensed import hat_functions
from ded_bench.koopman.linear import linear_model
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
    of_omega: Array32  # (n_gen, n_outputs n_knots)
    of_load: Array32  # (n_load n_nodes, n_outputs n_knots)
    of_power: Array32  # (n_gen n_knots, n_outputs n_knots)

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
        matrix = seen.transpose(2, 0, 3, 1).reshape(seen.shape[2], -1).astype(np.float32)
        parts = np.split(matrix, [n_omega, n_omega + n_loads])
        return Response(knots, nodes, 2 * (n_gen + 1), *parts)

    def undriven(self, omega: Array, p_load: Array) -> Array32:
        """What ω(0) and the loads would do without generators, (batch, n_knots, n_outputs).

        Args:
            omega: ω(0), (batch, n_gen), rad/s.
            p_load: load injections at the nodes, (batch, n_nodes, n_load), pu.
        """
        outputs = omega.astype(np.float32) @ self.of_omega
        outputs += _by_column(p_load) @ self.of_load
        return self._by_knot(outputs)

    def __call__(self, undriven: Array32, p_gen: Array) -> Array32:
        """ω (rad/s) and P_s (pu) at each knot, then halfway before it, (batch, n_knots, n_outputs).

        Args:
            undriven: see there.
            p_gen: powers at the knots, (batch, n_knots, n_gen), pu.
        """
        return undriven + self._by_knot(_by_column(p_gen) @ self.of_power)

    def _by_knot(self, outputs: Array32) -> Array32:
        """From (batch, n_outputs n_knots) to (batch, n_knots, n_outputs)."""
        return outputs.reshape(len(outputs), self.n_outputs, -1).swapaxes(1, 2)


def _by_column(values: Array) -> Array32:
    """From (batch, n, n_columns) to (batch, n_columns n), in float32."""
    return values.swapaxes(1, 2).reshape(len(values), -1).astype(np.float32)
