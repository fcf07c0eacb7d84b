"""Free responses at points coarser than the grid, at which loss and refinement evaluate ω and P_s."""

from __future__ import annotations

import numpy as np

from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.methods.dpc.response import Array32
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array
from ded_bench.surrogates.condensed import free_response
from ded_bench.surrogates.koopman import Koopman

#: Spacing of the points at which P_s and ω are evaluated, s. Frequencies are below 0.25 Hz.
SPACING_S = 0.1
#: Instances rolled out at once.
CHUNK = 500


def coarse_stride(dt_s: float, steps: int, spacing_s: float = SPACING_S) -> int:
    """Largest divisor of the number of steps that keeps to a spacing."""
    most = max(1, round(spacing_s / dt_s))
    return next(s for s in range(most, 0, -1) if steps % s == 0)


def coarse_free_response(
    network: Network, model: Koopman, inputs: Inputs, grid: Array, stride: int
) -> Array32:
    """`condensed.free_response` of instances, (batch, n_gen + 1, n_coarse), float32."""
    parts = []
    for start in range(0, len(inputs), CHUNK):
        part = inputs[start : start + CHUNK]
        p_load = part.p_load(grid)
        theta = network.power_flow(part.p_initial, p_load[:, 0])
        delta, omega = np.hsplit(part.state, 2)
        if delta.any():
            theta[:, network.generators] += delta
            theta, _ = network.solve_loads(theta, network.load_injections(p_load[:, 0]))
        psi = model.observables(network, theta, omega, p_load[:, 0])
        parts.append(free_response(model, psi, p_load, stride).astype(np.float32))
    return np.concatenate(parts)
