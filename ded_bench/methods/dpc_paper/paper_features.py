"""What the paper's policy sees of an instance: ζ = (loads, c, x_0, P_0)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance


def n_channels(case: Case) -> int:
    """Number of channels: loads, costs with the slack's, x_0 = (θ without the slack's, P_s, ω), P_0."""
    return len(case.loads) + (1 + len(case.generators)) + len(case.buses) + 2 * len(case.generators)


def channels(network: Network, instances: Sequence[Instance], knots: Array) -> Array:
    """ζ as channels over the knots, constants repeated, in the units of the files.

    Args:
        network: of the instances' case.
        knots: times, (n_knots,), s.

    Returns:
        Shape (batch, n_channels, n_knots): pu, cost per pu, rad, pu, rad/s, pu.

    Raises:
        PowerFlowError: an instance has no angles at t = 0.
    """
    case = network.case
    theta = np.stack([network.initial_angles(instance) for instance in instances])
    constant = np.concatenate(
        [
            [[i.cost_slack(case), *i.cost_gen(case)] for i in instances],
            theta[:, network.unknown],
            network.injections(theta)[:, [network.slack]],
            [i.omega_initial(case) for i in instances],
            [i.p_initial(case) for i in instances],
        ],
        axis=1,
    )
    repeated = np.broadcast_to(constant[:, :, None], (*constant.shape, len(knots)))
    p_load = np.stack([i.p_load(case, knots) for i in instances])
    return np.concatenate([p_load.transpose(0, 2, 1), repeated], axis=1)
